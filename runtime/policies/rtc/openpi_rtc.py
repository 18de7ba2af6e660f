"""Dialect of openpi-rtc and its forks: an envelope with the observation and the previous chunk.

These servers remove rows from the start of that chunk by themselves: the original always removes 25, whatever the robot
has executed, forks as many as the request states. The rows are therefore shifted so that the rows that remain on the
server begin at the first row that the robot has not consumed. If the robot has consumed exactly as many rows as the
server removes, the result is the chunk as received, which is all that these servers' own clients ever send.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from runtime.core.errors import ConfigurationError, ContradictionError
from runtime.core.settings import Settings
from runtime.core.types import Conditioning, Float32
from runtime.policies.rtc.base import Dialect, Message, declared_dialect

NAME = "openpi_rtc"
Rows = Literal["aligned", "whole"]


class EnvelopeKeys(Settings):
    """Keys of the envelope's parts, and number of rows that the server removes."""

    observation: Literal["obs", "observation"] = "obs"
    """Key of the observation."""
    flag: Literal["is_rtc", "use_rtc"] = "is_rtc"
    """Key of the flag that requests the continuation of a chunk."""
    shift: str = ""
    """Key of the number of rows that the server is to remove ("s_param" of one fork); "" if the server has none."""
    delay: str = ""
    """Key of the predicted delay in rows ("d_param"); "" if the server has none."""
    server_shift: int | None = None
    """Number of rows that the server removes by itself, 25 for the original; required with rtc_rows = "aligned" if
    `shift` is empty."""


class OpenpiRtc(Dialect):
    """Dialect with `prev_action` float32 [T, W], the previous chunk; absent on the first request and after a reset."""

    def __init__(self, keys: EnvelopeKeys, rows: Rows) -> None:
        if rows == "aligned" and not keys.shift and keys.server_shift is None:
            raise ConfigurationError(
                "policy.rtc = 'openpi_rtc' without policy.rtc_envelope.server_shift: the server takes rows off the "
                "chunk before, and another number than the robot has consumed would make it jump; allowed: "
                'server_shift = 25 (the ancestor\'s), shift = "s_param" for a fork that is told, or rtc_rows = '
                "'whole'"
            )
        self._keys = keys
        self._rows = rows

    def check_supported(self, metadata: Mapping[str, Any]) -> bool | None:
        """Return True if the metadata key `rtc` names this dialect, False if another, None without the key.

        Raises ContradictionError if the server removes another number of rows than the deployment states.
        """
        declared = declared_dialect(metadata, NAME)
        if declared is None:
            return None
        shift = declared.get("shift")
        if shift is not None and self._keys.server_shift not in (None, shift):
            raise ContradictionError(
                f"the server's metadata has rtc.shift = {shift!r}, policy.rtc_envelope.server_shift = "
                f"{self._keys.server_shift}; correct the one that is wrong"
            )
        return bool(declared["dialect"] == NAME)

    def wrap(self, observation: Message, conditioning: Conditioning | None) -> Message:
        """Return the envelope with the observation and, if there is conditioning, the previous chunk."""
        keys = self._keys
        message: Message = {keys.observation: observation}
        if conditioning is not None:
            message["prev_action"] = self._placed(conditioning)
        message[keys.flag] = conditioning is not None
        if conditioning is not None and keys.shift:
            message[keys.shift] = conditioning.consumed_rows
        if conditioning is not None and keys.delay:
            message[keys.delay] = conditioning.predicted_delay
        return message

    def unwrap(self, reply: Message) -> Message:
        """Return the reply itself."""
        return reply

    def _placed(self, conditioning: Conditioning) -> Float32:
        previous = conditioning.previous
        if self._rows == "whole" or self._keys.shift or self._keys.server_shift is None:
            return np.ascontiguousarray(previous, np.float32)
        # The server removes `server_shift` rows; after this shift its remainder begins at the first row not consumed.
        return shift_rows(previous, conditioning.consumed_rows - self._keys.server_shift)


def shift_rows(rows: Float32, by: int) -> Float32:
    """Shift rows [T, W]: row n becomes row n + `by`; the first and last row are repeated at the ends."""
    places = np.clip(np.arange(len(rows)) + by, 0, len(rows) - 1)
    return np.ascontiguousarray(rows[places], np.float32)
