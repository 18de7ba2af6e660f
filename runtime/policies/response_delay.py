"""Delay of a policy's responses in lockstep, where the duration of the server's work has no effect on the run."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from runtime.core.settings import Settings

Milliseconds = Annotated[float, Field(ge=0, le=60_000, allow_inf_nan=False)]


class ResponseDelaySettings(Settings):
    """Delay of the responses in lockstep."""

    delay_ms: Milliseconds | Annotated[list[Milliseconds], Field(min_length=1)] | None = None
    """Lockstep only: time from a request to its response [ms]. From a list, such as measured latencies, one is drawn
    for each response, at random with the seed of the bench. Absent: lockstep.delay_ticks. In real time it is not used,
    because a response then takes as long as it takes."""
