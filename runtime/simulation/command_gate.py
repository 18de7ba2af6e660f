"""Command filter of the simulated execution node.

Control words that switch the drives of a simulated robot (`runtime.simulation.drives`) are accepted from any client. A
node with a bench also accepts the word "scene_reset", with `id`, `seed` and optionally `positions`, `factors` and
`choices`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, cast, get_args

from runtime.core.command_filter import CommandFilter
from runtime.core.types import Float64
from runtime.simulation import drives
from runtime.simulation.bench.block_table import ResetRequest

if TYPE_CHECKING:
    from robots import Robot

Control = Literal["collect_start", "collect_stop", "hil_start", "hil_stop"]
ACTING = ("policy", "teleop")  # sources of rows; others are motions and holds of the station's own
_RESET = "scene_reset"
_LONGEST_ID = 128  # characters


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


class CommandGate(CommandFilter):
    """Filter that also accepts control words, switches of the drives and resets of a bench.

    `bench` is True if the node has a bench that can be reset. With `as_given`, targets may be beyond the robot's
    limits, as in a benchmark that limits them itself.
    """

    def __init__(self, robot: Robot, deadline: float, bench: bool = False, as_given: bool = False) -> None:
        super().__init__(robot.dim, deadline, None if as_given else (robot.lower, robot.upper))
        self._bench = bench

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
            self._acknowledge(message)
        return accepted

    def _accept(self, word: str, message: dict[Any, Any], arrival: float) -> AcceptedCommand | None:
        if word == "real":
            target = self._target(message, arrival)
            return target if target is None else AcceptedCommand(target, message.get("source") in ACTING)
        if word in get_args(Control):
            return AcceptedCommand(control=cast(Control, word))
        if word == _RESET:
            return self._reset(message)
        if word != "sim":
            self.refused["unknown_target"] += 1
        return None

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
