"""Two flat keys in the observation: `prev_action` and `rtc_params`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from runtime.core.types import Conditioning, Float32
from runtime.policies.rtc.base import Dialect, Message, declared_dialect

NAME = "prev_action"


class PrevAction(Dialect):
    """`prev_action` float32 [T, W] is what is left of the chunk before, padded with its last row to its length.

    `rtc_params` = {"s": rows that were removed}. Both are absent on the first request and after a reset. A server
    that does not know them drops them without a word, and most say nothing of themselves.
    """

    def check_supported(self, metadata: Mapping[str, Any]) -> bool | None:
        """True if the metadata key `rtc` (that of our bundled server) names this dialect; None without it."""
        said = declared_dialect(metadata, NAME)
        return None if said is None else bool(said["dialect"] == NAME)

    def wrap(self, observation: Message, conditioning: Conditioning | None) -> Message:
        """The observation with both keys, or as it is."""
        if conditioning is None:
            return observation
        return observation | {
            "prev_action": pad_rows(conditioning.remaining_rows, len(conditioning.previous)),
            "rtc_params": {"s": conditioning.consumed_rows},
        }

    def unwrap(self, reply: Message) -> Message:
        """The reply itself."""
        return reply


def pad_rows(rows: Float32, count: int) -> Float32:
    """`rows` and then the last of them until there are `count`."""
    missing = count - len(rows)
    return np.ascontiguousarray(np.concatenate([rows, np.repeat(rows[-1:], missing, axis=0)]), np.float32)
