"""Flat keys of kai0: the chunk before as nested lists, the predicted delay, the end of the transition.

The server compares row n of that chunk with row n of the new one, so it has to begin at the first row that the robot
has not consumed. kai0's own client sends the whole chunk as it was answered, which is right only where nothing was
consumed; `rows` = "whole" does as it does. Rows are the robot's numbers, never the model's own.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from runtime.core.types import Conditioning, Float32
from runtime.policies.rtc.base import Dialect, Message, declared_dialect
from runtime.policies.rtc.openpi_rtc import Rows
from runtime.policies.rtc.prev_action import pad_rows

NAME = "kai0"
_COLUMNS = 32  # of the model: rows are padded with zeros to it, or cropped


class Kai0(Dialect):
    """All but `prev_action_chunk` is on every request; the server ignores the last three keys."""

    continues_model_rows = False

    def __init__(self, rows: Rows, max_guidance_weight: float) -> None:
        self._rows = rows
        self._weight = max_guidance_weight

    def check_supported(self, metadata: Mapping[str, Any]) -> bool | None:
        """True if the metadata key `rtc` names this dialect; None without it."""
        said = declared_dialect(metadata, NAME)
        return None if said is None else bool(said["dialect"] == NAME)

    def wrap(self, observation: Message, conditioning: Conditioning | None) -> Message:
        """The observation with the keys."""
        chunk, delay, horizon = self._continued(conditioning)
        return {
            **observation,
            **chunk,
            "inference_delay": delay,
            "execute_horizon": horizon,
            "enable_rtc": True,
            "mask_prefix_delay": False,
            "max_guidance_weight": self._weight,
        }

    def unwrap(self, reply: Message) -> Message:
        """The reply itself."""
        return reply

    def _continued(self, conditioning: Conditioning | None) -> tuple[Message, int, int]:
        """The chunk, the delay, and the row at which nothing of it is followed any more."""
        if conditioning is None:
            return {}, 0, 1
        delay, end = conditioning.predicted_delay, conditioning.execution_horizon
        rows = conditioning.previous
        if self._rows == "aligned":
            left = conditioning.remaining_rows
            rows, end = pad_rows(left, len(rows)), max(delay, min(end, len(left)))
        return {"prev_action_chunk": _nested_lists(rows).tolist()}, delay, max(1, end)


def _nested_lists(rows: Float32) -> np.ndarray[Any, np.dtype[np.float64]]:
    made = np.zeros((len(rows), _COLUMNS))
    kept = min(_COLUMNS, rows.shape[1])
    made[:, :kept] = rows[:, :kept]
    return made
