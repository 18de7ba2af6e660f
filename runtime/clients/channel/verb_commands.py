"""Commands of EVA Web for a verb of the older channel, and parsers for the verb's arguments."""

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
    """Error about a verb or argument that has no meaning here; the message names an alternative."""


@dataclass(frozen=True, slots=True)
class CommandSequence:
    """Commands to send in order; empty if the verb requires no action of the station. The last command's result counts.

    `chosen` are choices that are recorded after all commands were accepted. `told` are further keys of the answer, and
    `note` is the reason in the answer.
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
        """Check that the verb was given no argument. Raises: UnsupportedVerb."""
        if self.message.argument:
            self.refuse(f"takes no argument; given {self.message.argument!r:.80}")

    def text_argument(self, key: str = "") -> str:
        """Return the required argument of the verb.

        It is the message's field `key`, if `key` is given and the message has this field; otherwise the argument after
        the colon. Raises: UnsupportedVerb if there is no argument.
        """
        value = self.message.fields.get(key, self.message.argument) if key else self.message.argument
        if not isinstance(value, str) or not value.strip():
            self.refuse(f"needs {f'{key!r} in the message, or ' if key else ''}an argument after a colon")
        return value.strip()

    def choice_argument(self, *allowed: str) -> str:
        """Return the argument if it is one of `allowed`. Raises: UnsupportedVerb."""
        choice = self.text_argument()
        if choice not in allowed:
            self.refuse(f"{choice!r:.80} is none of {', '.join(allowed)}")
        return choice

    def table(self) -> dict[str, Any]:
        """Parse the argument as a JSON object. Raises: UnsupportedVerb."""
        try:
            table = json.loads(self.text_argument())
        except (ValueError, RecursionError) as error:
            self.refuse(f"its argument is not JSON: {error}")
        if not isinstance(table, dict):
            self.refuse(f"its argument is a JSON object; given {table!r:.80}")
        return table

    def joints(self, values: object) -> list[float]:
        """Check for one finite number per joint; return them as floats [D]. Raises: UnsupportedVerb."""
        names = self.status["facts"]["joint_names"]
        good = isinstance(values, list) and all(
            isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
            for value in values
        )
        if not good or len(values) != len(names):  # type: ignore[arg-type]
            self.refuse(f"needs {len(names)} finite numbers ({', '.join(names)}); given {values!r:.80}")
        return [float(value) for value in values]  # type: ignore[attr-defined]

    def number(self, said: str) -> float:
        """Parse a finite number. Raises: UnsupportedVerb."""
        try:
            number = float(said)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            self.refuse(f"{said!r:.80} is no finite number")
        return number

    def arm(self, side: str) -> str:
        """Return the name of the arm with a gripper that `side` names, in full or by its beginning.

        The only gripper of a robot counts as left and as right. Raises: UnsupportedVerb.
        """
        arms: list[str] = self.status["facts"]["arms"]
        grips = [arm for arm in arms if arm in self.status["grippers"]]
        matches = [arm for arm in grips if side and (arm == side or arm.startswith(side))]
        if not matches and side in ("l", "r", "left", "right") and len(grips) == 1:
            matches = grips
        if len(matches) != 1:
            self.refuse(f"{side!r:.80} is no gripper of this robot; allowed: {', '.join(grips) or 'none'}")
        return matches[0]
