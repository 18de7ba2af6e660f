"""Form of a draft: the settings of a deployment of a real robot, with the values typed so far."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import robots
from evaweb.core.errors import EvaError
from evaweb.lab.deployments import BY_HAND
from runtime.config import draft
from runtime.config.draft import Entry
from runtime.config.loader import ConfigurationError

FROM_TRANSPORT = ""  # camera whose images come from the robot's own node
_USUAL = {"transport": "zmq", "policy": "openpi", "cameras": FROM_TRANSPORT}
_TITLES = {"transport": "Way to the robot", "policy": "Policy server"}


@dataclass(frozen=True, slots=True)
class Typed:
    """Field of the form: a key of the deployment, and the text in its field."""

    name: str
    entry: Entry
    value: str


@dataclass(frozen=True, slots=True)
class Part:
    """Table of the deployment: its kind, the available kinds with descriptions, and its keys.

    `hidden` are keys for which the form has no field, with the values that were sent for them anyway.
    """

    place: str
    title: str
    kind: str
    kinds: Mapping[str, str]
    keys: tuple[Typed, ...]
    hidden: tuple[Typed, ...]

    @property
    def asked(self) -> list[Typed]:
        """Keys whose values are network addresses; the form asks for them first."""
        return [key for key in self.keys if key.entry.address]

    @property
    def further(self) -> list[Typed]:
        """Keys whose values are not network addresses."""
        return [key for key in self.keys if not key.entry.address]


@dataclass(frozen=True, slots=True)
class DraftForm:
    """Form of a draft: name, robot, task, and the tables of the deployment."""

    name: str
    robot: str
    robots: tuple[str, ...]
    task: str
    parts: tuple[Part, ...]

    @property
    def tables(self) -> dict[str, dict[str, str]]:
        """Kind and typed values of each table to be written, by the table's place in the deployment."""
        return {
            part.place: {
                "kind": part.kind,
                **{key.entry.key: key.value for key in (*part.keys, *part.hidden)},
            }
            for part in self.parts
            if part.kind
        }


def form_of(given: Mapping[str, str]) -> DraftForm:
    """Return the form with the values in its fields.

    Raises:
        EvaError: If a robot or a kind does not exist; the message names the valid ones.
    """
    names = tuple(robots.robot_names())
    robot = given.get("robot", names[0])
    if robot not in names:
        raise EvaError(f"robot = {robot!r:.60}; allowed: {', '.join(names)}")
    try:
        cameras = [f"cameras.{camera.key}" for camera in robots.load_robot(robot).cameras]
    except robots.RobotError as fault:  # a robot folder of the lab's own may be broken
        raise EvaError(str(fault)) from None
    parts = tuple(_part(place, given) for place in ("transport", "policy", *cameras))
    return DraftForm(given.get("station", ""), robot, names, given.get("task", ""), parts)


def _part(place: str, values: Mapping[str, str]) -> Part:
    part, _, camera = place.partition(".")
    kinds = {kind: description for kind, description in draft.kinds(part).items() if kind != "none"}
    kind = values.get(f"{place}.kind", _USUAL[part])
    if kind not in kinds and not (camera and kind == FROM_TRANSPORT):
        raise EvaError(f"{place}.kind = {kind!r:.40}; allowed: {', '.join(kinds)}")
    try:
        entries = draft.entries(part, kind) if kind else ()
    except ConfigurationError as fault:  # a plug-in that cannot be imported here
        raise EvaError(str(fault)) from None
    typed = tuple(
        Typed(f"{place}.{entry.key}", entry, values.get(f"{place}.{entry.key}", entry.default))
        for entry in entries
    )
    keys = tuple(key for key in typed if (part, key.entry.key) not in BY_HAND)
    hidden = tuple(key for key in typed if (part, key.entry.key) in BY_HAND)
    return Part(place, _TITLES.get(part, camera), kind, kinds, keys, hidden)
