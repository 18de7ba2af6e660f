"""Conversion of a model's own range -1 .. 1 to the robot's values, for servers that leave it to their clients."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from runtime.core.errors import ConfigurationError
from runtime.core.settings import Settings
from runtime.core.types import Float32

Numbers = Annotated[list[float], Field(min_length=1)]


class Statistics(Settings):
    """Values that -1 and 1 represent, per number of a row: minimum and maximum, or quantiles, of the training data."""

    low: Numbers
    """Values that -1 represents."""
    high: Numbers
    """Values that 1 represents; above `low` wherever `mask` is true."""
    mask: list[bool] | None = None
    """Which numbers were normalised; the others (mostly grippers) are left unchanged. Absent: all were."""

    @model_validator(mode="after")
    def _fit(self) -> Statistics:
        mask = self.mask if self.mask is not None else [True] * len(self.low)
        if not len(self.low) == len(self.high) == len(mask):
            raise ConfigurationError(
                f"low has {len(self.low)} numbers, high {len(self.high)}, mask {len(mask)}; allowed: the same"
            )
        wrong = [n for n, (a, b, m) in enumerate(zip(self.low, self.high, mask, strict=True)) if m and a >= b]
        if wrong:
            raise ConfigurationError(
                f"low is not below high at {wrong}; allowed: low < high where mask is true"
            )
        return self

    def require_width(self, width: int) -> None:
        """Raise ConfigurationError if these statistics are not for rows of `width` values."""
        if len(self.low) != width:
            raise ConfigurationError(
                f"policy.statistics has {len(self.low)} numbers; the rows of this robot have {width}"
            )

    def denormalize(self, rows: Float32) -> Float32:
        """Return the robot's values for normalised rows [T, W], which are clipped to -1 .. 1."""
        low, high = np.asarray(self.low), np.asarray(self.high)
        scaled = low + (np.clip(rows, -1.0, 1.0) + 1.0) / 2.0 * (high - low)
        mask = np.ones(len(low), bool) if self.mask is None else np.asarray(self.mask)
        return np.where(mask, scaled, rows).astype(np.float32)
