"""The base of every part of a deployment file."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Settings(BaseModel):
    """A frozen table of a deployment file, in which nothing is coerced.

    Unknown keys, wrong types, NaN and infinity are errors.
    """

    # A limit of infinity or NaN would be no limit at all, and neither is valid in a manifest's JSON.
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)
