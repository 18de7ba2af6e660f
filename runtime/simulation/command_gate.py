"""Command filter of a careful execution node: one master; targets that are fresh, finite and within limits; a deadline.

Control words that switch the drives of a simulated robot (`runtime.simulation.drives`) are accepted from any client. A
node with a bench also accepts the word "scene_reset", with `id`, `seed` and optionally `positions`, `factors` and
`choices`.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, cast, get_args

import numpy as np

from runtime.core import msgpack_arrays
from runtime.core.clock import ClockMap
from runtime.core.errors import CodecError
from runtime.core.types import Float64
from runtime.simulation import drives
from runtime.simulation.bench.block_table import ResetRequest

if TYPE_CHECKING:
    from robots import Robot

Control = Literal["collect_start", "collect_stop", "hil_start", "hil_stop"]
ACTING = ("policy", "teleop")  # sources of rows; others are motions and holds of the station's own
ANONYMOUS = "anonymous"  # name of clients that send none, as older versions
MASTER_SILENCE = 1.0  # [s] silence after which another client may become master
_TOLERANCE = 1e-5  # limits are transmitted as float32
_RESET = "scene_reset"
_LONGEST_ID = 128  # characters
_MESSAGE_LIMIT = 1024 * 1024  # [bytes]; a command has a few hundred


@dataclass(frozen=True, slots=True)
class AcceptedCommand:
    """Accepted message; exactly one field is set: a target [D], a control word, a bench reset or a switch of the
    drives. A target is `acting` if it is a row of a policy or of a leader.
    """

    target: Float64 | None = None
    acting: bool = False
    control: Control | None = None
    reset: ResetRequest | None = None
    switch: drives.DriveSwitch | None = None


class CommandGate:
    """Filter that decides which command messages take effect, by their arrival time on the node's own clock.

    `refused` counts rejected messages by reason. A target is also refused if it was sent more than `deadline` [s] ago
    according to the master's own clock, provided that this clock advances. `ack` is the `seq` of the master's newest
    message that took effect, None if the master does not number its messages. `bench` is True if the node has a bench
    that can be reset. With `as_given`, targets may be beyond the robot's limits, as in a benchmark that limits them
    itself.
    """

    def __init__(self, robot: Robot, deadline: float, bench: bool = False, as_given: bool = False) -> None:
        self._robot = robot
        self._as_given = as_given
        self._deadline = deadline
        self._bench = bench
        self._heard = float("-inf")  # arrival of the master's last message, accepted or not
        self._accepted = float("-inf")
        self._stamp = float("-inf")  # stamp of the master's newest command, on its clock
        self._clock = ClockMap()
        self.master: str | None = None
        self.ack: int | None = None
        self.refused: Counter[str] = Counter()

    def accept(self, payload: bytes, arrival: float) -> AcceptedCommand | None:
        """Return the command in a message, or None if it may not take effect.

        A rejected message is counted in `refused`. Messages with target "sim" have no effect and are not counted.
        `arrival` is the time of reception on the node's clock [s].
        """
        message = self._message(payload)
        if message is None:
            return None
        word = message.get("target", "real")
        if word in drives.WORDS:
            return self._switch(word, message)
        if not self._rules(message, arrival):
            return None
        accepted = self._accept(word, message, arrival)
        if accepted is not None:
            number = message.get("seq")
            self.ack = number if type(number) is int else None
        return accepted

    def _accept(self, word: str, message: dict[Any, Any], arrival: float) -> AcceptedCommand | None:
        if word == "real":
            return self._target(message, arrival)
        if word in get_args(Control):
            return AcceptedCommand(control=cast(Control, word))
        if word == _RESET:
            return self._reset(message)
        if word != "sim":
            self.refused["unknown_target"] += 1
        return None

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

    def _switch(self, word: str, message: dict[Any, Any]) -> AcceptedCommand | None:
        """Return the command to switch the drives on or off, None if the message is malformed.

        Any client may send this command. Operators at the robot send it, so the sender does not become the master.
        """
        switch = drives.parse_switch(word, message)
        if switch is None:
            self.refused["malformed"] += 1
            return None
        return AcceptedCommand(switch=switch)

    def _reset(self, message: dict[Any, Any]) -> AcceptedCommand | None:
        name, seed, *tables = (message.get(key) for key in ("id", "seed", "positions", "factors", "choices"))
        if not self._bench:
            self.refused["no_bench"] += 1
            return None
        named = isinstance(name, str) and 0 < len(name) <= _LONGEST_ID
        seeded = isinstance(seed, int) and not isinstance(seed, bool) and seed >= 0
        if not (named and seeded and all(table is None or isinstance(table, dict) for table in tables)):
            self.refused["malformed"] += 1
            return None
        return AcceptedCommand(reset=ResetRequest(str(name), int(seed or 0), *tables))

    def _target(self, message: dict[Any, Any], arrival: float) -> AcceptedCommand | None:
        action = message.get("action")
        reason = "stale" if self._late(message.get("t"), arrival) else self._wrong(action)
        if reason:
            self.refused[reason] += 1
            return None
        self._accepted = arrival
        target = np.asarray(action, np.float64)
        if not self._as_given:
            target = np.clip(target, self._robot.lower, self._robot.upper)
        return AcceptedCommand(target=target, acting=message.get("source") in ACTING)

    def _late(self, stamp: object, arrival: float) -> bool:
        """Return True if the target was sent longer ago than the deadline.

        Return False if the age of the target is unknown. It is unknown if the target has no stamp, or if the sender's
        clock does not advance.
        """
        if type(stamp) not in (int, float) or not math.isfinite(cast(float, stamp)):
            return False
        before, self._stamp = self._stamp, cast(float, stamp)
        if before == self._stamp:
            return False  # the clock does not advance, so age is unknown
        return arrival - self._clock.map(self._stamp, arrival) > self._deadline

    def _wrong(self, action: object) -> str:
        if not isinstance(action, np.ndarray) or action.dtype.kind != "f":
            return "malformed"
        if action.shape != (self._robot.dim,):
            return "dimension"
        if not np.isfinite(action).all():
            return "not_finite"
        if self._as_given:
            return ""
        low, high = self._robot.lower - _TOLERANCE, self._robot.upper + _TOLERANCE
        return "" if ((action >= low) & (action <= high)).all() else "limits"
