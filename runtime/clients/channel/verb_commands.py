"""Commands of ours for a verb of the older channel, and the small words its arguments are made of."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NoReturn

from runtime.clients.channel.message import Message
from runtime.clients.channel.scripts import ScriptSelection
from runtime.core.errors import RuntimeFault

Step = tuple[str, Mapping[str, Any]]


class UnsupportedVerb(RuntimeFault):
    """A verb, or an argument of one, that means nothing here; the sentence says what to give instead."""


@dataclass(frozen=True, slots=True)
class CommandSequence:
    """Commands of ours in their order, none where nothing is asked of the station; the last one's result counts.

    `chosen` is remembered once they were accepted; `told` are further keys of the answer, `note` its reason.
    """

    steps: tuple[Step, ...] = ()
    chosen: Mapping[str, Any] = field(default_factory=dict)
    told: Mapping[str, Any] = field(default_factory=dict)
    note: str = ""


@dataclass(frozen=True, slots=True)
class VerbContext:
    """Context of a verb: the message, the station's status, the script's choices, the commanded joints."""

    message: Message
    status: Mapping[str, Any]
    selection: ScriptSelection
    commanded: Callable[[], list[float]]

    @property
    def state(self) -> str:
        return str(self.status["state"])

    @property
    def state_is(self) -> Mapping[str, Any]:
        return self.status["state_is"]  # type: ignore[no-any-return]

    @property
    def verb(self) -> str:
        return f"web:{self.message.name}"

    def refuse(self, why: str) -> NoReturn:
        raise UnsupportedVerb(f"{self.verb}: {why}")

    def no_argument(self) -> None:
        """Refuse an argument where none belongs."""
        if self.message.argument:
            self.refuse(f"takes no argument; given {self.message.argument!r:.80}")

    def text_argument(self, key: str = "") -> str:
        """The argument, which has to be there; `key` of the message goes before it."""
        said = self.message.fields.get(key, self.message.argument) if key else self.message.argument
        if not isinstance(said, str) or not said.strip():
            self.refuse(f"needs {f'{key!r} in the message, or ' if key else ''}an argument after a colon")
        return said.strip()

    def choice_argument(self, *allowed: str) -> str:
        """The argument, one of `allowed`."""
        said = self.text_argument()
        if said not in allowed:
            self.refuse(f"{said!r:.80} is none of {', '.join(allowed)}")
        return said

    def table(self) -> dict[str, Any]:
        """The argument as a JSON object."""
        try:
            found = json.loads(self.text_argument())
        except (ValueError, RecursionError) as error:
            self.refuse(f"its argument is not JSON: {error}")
        if not isinstance(found, dict):
            self.refuse(f"its argument is a JSON object; given {found!r:.80}")
        return found

    def joints(self, values: object) -> list[float]:
        """One finite number per joint of the robot."""
        names = self.status["facts"]["joint_names"]
        good = isinstance(values, list) and all(
            isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
            for value in values
        )
        if not good or len(values) != len(names):  # type: ignore[arg-type]
            self.refuse(f"needs {len(names)} finite numbers ({', '.join(names)}); given {values!r:.80}")
        return [float(value) for value in values]  # type: ignore[attr-defined]

    def number(self, said: str) -> float:
        """A finite number."""
        try:
            found = float(said)
        except ValueError:
            found = math.nan
        if not math.isfinite(found):
            self.refuse(f"{said!r:.80} is no finite number")
        return found

    def arm(self, side: str) -> str:
        """The arm of a side: its name, or what its name begins with; a robot of one arm has it on both."""
        arms: list[str] = self.status["facts"]["arms"]
        grips = [arm for arm in arms if arm in self.status["grippers"]]
        found = [arm for arm in grips if side and (arm == side or arm.startswith(side))]
        if not found and side in ("l", "r", "left", "right") and len(grips) == 1:
            found = grips
        if len(found) != 1:
            self.refuse(f"{side!r:.80} is no gripper of this robot; allowed: {', '.join(grips) or 'none'}")
        return found[0]
