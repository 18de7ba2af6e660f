"""Dialect of kai0, with flat keys: the previous chunk as nested lists, the predicted delay, the end of the transition.

The server compares row n of the previous chunk with row n of the new chunk, so the previous chunk must begin at the
first row that the robot has not consumed. kai0's own client sends the whole chunk as received, which is right only if
nothing was consumed; with `rows` = "whole" this dialect does the same. Rows contain the robot's values, never the
model's own.
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
_COLUMNS = 32  # width of the model: rows are padded with zeros or cropped


class Kai0(Dialect):
    """Dialect whose keys are in every request, except `prev_action_chunk`, which needs a previous chunk.

    The server ignores `enable_rtc`, `mask_prefix_delay` and `max_guidance_weight`.
    """

    continues_model_rows = False

    def __init__(self, rows: Rows, max_guidance_weight: float) -> None:
        self._rows = rows
        self._weight = max_guidance_weight

    def check_supported(self, metadata: Mapping[str, Any]) -> bool | None:
        """Return True if the metadata key `rtc` names this dialect, False if another, None without the key."""
        declared = declared_dialect(metadata, NAME)
        return None if declared is None else bool(declared["dialect"] == NAME)

    def wrap(self, observation: Message, conditioning: Conditioning | None) -> Message:
        """Return the observation with the dialect's keys."""
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
        """Return the reply itself."""
        return reply

    def _continued(self, conditioning: Conditioning | None) -> tuple[Message, int, int]:
        """Return the map that carries the previous chunk, the delay, and the first row that is free.

        The map has a single key, or none without conditioning. The free rows are those that do not have to follow the
        previous chunk.
        """
        if conditioning is None:
            return {}, 0, 1
        delay, end = conditioning.predicted_delay, conditioning.execution_horizon
        rows = conditioning.previous
        if self._rows == "aligned":
            left = conditioning.remaining_rows  # the padding after them is no plan and must not be followed
            rows, end = pad_rows(left, len(rows)), max(delay, min(end, len(left)))
        return {"prev_action_chunk": _nested_lists(rows).tolist()}, delay, max(1, end)


def _nested_lists(rows: Float32) -> np.ndarray[Any, np.dtype[np.float64]]:
    padded = np.zeros((len(rows), _COLUMNS))
    width = min(_COLUMNS, rows.shape[1])
    padded[:, :width] = rows[:, :width]
    return padded
