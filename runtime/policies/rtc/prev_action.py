"""Dialect with two flat keys in the observation: `prev_action` and `rtc_params`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from runtime.core.types import Conditioning, Float32
from runtime.policies.rtc.base import Dialect, Message, declared_dialect

NAME = "prev_action"


class PrevAction(Dialect):
    """Dialect with `prev_action` float32 [T, W]: the rest of the previous chunk, padded with its last row to T rows.

    `rtc_params` is {"s": number of consumed rows}. Both are absent on the first request and after a reset. A server
    that does not know the keys drops them without an error, and most do not declare whether they know them.
    """

    def check_supported(self, metadata: Mapping[str, Any]) -> bool | None:
        """Return True if the metadata key `rtc` (of our bundled server) names this dialect, False if another, None
        without it.
        """
        declared = declared_dialect(metadata, NAME)
        return None if declared is None else bool(declared["dialect"] == NAME)

    def wrap(self, observation: Message, conditioning: Conditioning | None) -> Message:
        """Return the observation with the keys `prev_action` and `rtc_params`.

        Without conditioning the observation itself is returned.
        """
        if conditioning is None:
            return observation
        return observation | {
            "prev_action": pad_rows(conditioning.remaining_rows, len(conditioning.previous)),
            "rtc_params": {"s": conditioning.consumed_rows},
        }

    def unwrap(self, reply: Message) -> Message:
        """Return the reply itself."""
        return reply


def pad_rows(rows: Float32, count: int) -> Float32:
    """Return `rows`, followed by copies of the last row up to `count` rows."""
    missing = count - len(rows)
    return np.ascontiguousarray(np.concatenate([rows, np.repeat(rows[-1:], missing, axis=0)]), np.float32)
