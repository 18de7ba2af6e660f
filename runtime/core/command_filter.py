"""Command filter of a careful execution node: one master; targets that are fresh and finite; a deadline."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any, cast

import numpy as np

from runtime.core import msgpack_arrays
from runtime.core.clock import ClockMap
from runtime.core.errors import CodecError
from runtime.core.types import Float64

ANONYMOUS = "anonymous"  # name of clients that send none, as older versions
MASTER_SILENCE = 1.0  # [s] silence after which another client may become master
_AHEAD = 0.05  # [s] by which a stamp of the same clock may be ahead of its arrival: times are rounded
_TOLERANCE = 1e-5  # limits are transmitted as float32
_MESSAGE_LIMIT = 1024 * 1024  # [bytes]; a command has a few hundred


class CommandFilter:
    """Filter that decides which command messages take effect, by their arrival time on the node's own clock.

    `refused` counts rejected messages by reason. A target is also refused if it was sent more than `deadline` [s] ago
    according to the master's own clock, provided that this clock advances; with `same_clock`, master and node have one
    clock, the age of every target is known, and one without a stamp, or with one of the future, is refused. `sent` is
    the time of the newest target's sending on the node's clock, that of its arrival if it is unknown, and `source` what
    drives the robot by it. `ack` is the `seq` of the master's newest
    message that took effect, None if the master does not number its messages. Targets have `dim` numbers within
    `limits` (lower and upper [D]), if given.
    """

    def __init__(
        self,
        dim: int,
        deadline: float,
        limits: tuple[Float64, Float64] | None = None,
        same_clock: bool = False,
    ) -> None:
        self._dim = dim
        self._same_clock = same_clock
        self._limits = limits
        self._deadline = deadline
        self._heard = float("-inf")  # arrival of the master's last message, accepted or not
        self._accepted = float("-inf")
        self._stamp = float("-inf")  # stamp of the master's newest command, on its clock
        self._clock = ClockMap()
        self.master: str | None = None
        self.ack: int | None = None
        self.sent = float("-inf")
        self.source = ""
        self.refused: Counter[str] = Counter()

    def accept_target(self, payload: bytes, arrival: float) -> Float64 | None:
        """Return the target [D] in a message, or None if it has none or it may not take effect.

        A rejected message is counted in `refused`. Messages with target "sim" have no effect and are not counted.
        `arrival` is the time of reception on the node's clock [s].
        """
        message = self._message(payload)
        if message is None or not self._rules(message, arrival):
            return None
        word = message.get("target", "real")
        if word not in ("real", "sim"):
            self.refused["unknown_target"] += 1
        if word != "real" or (target := self._target(message, arrival)) is None:
            return None
        self._acknowledge(message)
        return target

    def is_silent(self, now: float) -> bool:
        """Return True if no target was accepted within the deadline before `now`, so that the robot has to hold."""
        return now - self._accepted > self._deadline

    def _message(self, payload: bytes) -> dict[Any, Any] | None:
        try:
            message = msgpack_arrays.unpack(payload, _MESSAGE_LIMIT)
        except CodecError:
            message = None
        if not isinstance(message, dict) or not isinstance(message.get("target", "real"), str):
            self.refused["malformed"] += 1
            return None
        return message

    def _rules(self, message: dict[Any, Any], arrival: float) -> bool:
        """Return True if the sender of a message is the master or becomes it.

        Another sender becomes the master only after the present one has been silent for MASTER_SILENCE.
        """
        name = message.get("master")
        name = name if isinstance(name, str) else ANONYMOUS
        if self.master != name and self.master is not None and arrival - self._heard <= MASTER_SILENCE:
            self.refused["other_master"] += 1
            return False
        if self.master != name:
            self.master, self.ack = name, None
            self._stamp, self._clock = float("-inf"), ClockMap()  # every master has its own clock
        self._heard = arrival
        return True

    def _acknowledge(self, message: dict[Any, Any]) -> None:
        number = message.get("seq")
        self.ack = number if type(number) is int else None

    def _target(self, message: dict[Any, Any], arrival: float) -> Float64 | None:
        action = message.get("action")
        stamp, source = message.get("t"), message.get("source")
        reason = "stale" if self._late(stamp, arrival) else self._wrong(action)
        if reason:
            self.refused[reason] += 1
            return None
        self._accepted = arrival
        self.sent = cast(float, stamp) if self._same_clock else arrival
        self.source = source if isinstance(source, str) else ""
        target = np.asarray(action, np.float64)
        return target if self._limits is None else np.clip(target, *self._limits)

    def _late(self, stamp: object, arrival: float) -> bool:
        """Return True if the target was sent longer ago than the deadline.

        Without one clock, return False if the age of the target is unknown. It is unknown if the target has no stamp,
        or if the sender's clock does not advance.
        """
        known = type(stamp) in (int, float) and math.isfinite(cast(float, stamp))
        if self._same_clock:
            return not known or not -_AHEAD <= arrival - cast(float, stamp) <= self._deadline
        if not known:
            return False
        before, self._stamp = self._stamp, cast(float, stamp)
        if before == self._stamp:
            return False  # the clock does not advance, so age is unknown
        return arrival - self._clock.map(self._stamp, arrival) > self._deadline

    def _wrong(self, action: object) -> str:
        if not isinstance(action, np.ndarray) or action.dtype.kind != "f":
            return "malformed"
        if action.shape != (self._dim,):
            return "dimension"
        if not np.isfinite(action).all():
            return "not_finite"
        if self._limits is None:
            return ""
        low, high = self._limits[0] - _TOLERANCE, self._limits[1] + _TOLERANCE
        return "" if ((action >= low) & (action <= high)).all() else "limits"
