"""Arguments of the session's commands: validated completely before a command has any effect."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, Field, JsonValue, ValidationError

from runtime.core.errors import RuntimeFault
from runtime.core.sentences import Pattern
from runtime.core.settings import Settings, explain_validation_error
from runtime.core.types import Result
from runtime.ipc.messages import Mode

_TAKES_NONE = Pattern("commands.takes_none", "{kind} takes no arguments; given: {given}")

LARGEST = 64 * 1024  # characters of JSON that a command may add to a manifest
_HIGHEST_SEED = 2**53 - 1  # largest integer of a browser's number


def _small(given: dict[str, JsonValue]) -> dict[str, JsonValue]:
    size = len(json.dumps(given))
    if size > LARGEST:
        raise ValueError(f"must be at most {LARGEST} characters of JSON, and is {size}")
    return given


Map = Annotated[dict[str, JsonValue], AfterValidator(_small)]
Label = Annotated[str, Field(max_length=200)]


class Nothing(Settings):
    """For commands that are one word."""


class Checkpoint(Settings):
    """Which checkpoint is behind the policy, as the one who asks knows it."""

    id: Annotated[str, Field(min_length=1, max_length=200)] | int
    name: Label = ""


class Positions(Settings):
    """Positions wanted on the bench, in the world: x, y [m], yaw [degrees]; what is absent lies anywhere."""

    block: list[float] | None = Field(default=None, min_length=3, max_length=3)
    plate: list[float] | None = Field(default=None, min_length=2, max_length=2)


class BenchRequest(Settings):
    """Layout wanted of a simulated bench; `id` names this reset, one is made up where none is given."""

    id: Annotated[str, Field(min_length=1, max_length=200)] | None = None
    seed: int = Field(ge=0, le=_HIGHEST_SEED)
    positions: Positions | None = None


class LeastTimes(Settings):
    """Least durations of the stages of a set-up that wait for the policy [s], whichever it is."""

    connect_s: float = Field(default=0.0, ge=0, le=3600)
    warm_up_s: float = Field(default=0.0, ge=0, le=3600)


class SetUpRequest(Settings):
    """`setup`: what differs from the deployment this time; what is absent is the deployment's own.

    `policy` is merged into the deployment's own [policy] as a file over what it extends: a table of another
    `kind` replaces it whole. `checkpoint` is only written down. `collect`: a person is to drive the robot, as the
    deployment's [collection] says; absent: where the deployment has no policy. `least`: so that nobody can tell two
    policies by how long they take.
    """

    policy: Map | None = None
    strategy: Map | None = None
    task: Annotated[str, Field(max_length=2000)] | None = None
    checkpoint: Checkpoint | None = None
    bench: BenchRequest | None = None
    collect: bool | None = None
    least: LeastTimes = LeastTimes()

    @property
    def changes(self) -> dict[str, Any]:
        """Tables that override the deployment's."""
        wanted = {"policy": self.policy, "strategy": self.strategy, "task": self.task}
        return {key: value for key, value in wanted.items() if value is not None}


class PreflightRequest(Settings):
    """`preflight`: which policy is asked without the robot; what is absent is the deployment's own.

    `policy` and `strategy` as in a set-up; `id` names the report; it ends after `deadline_s` [s] at the latest, without
    it after what the policy's own deadlines come to.
    """

    id: Annotated[str, Field(min_length=1, max_length=200)]
    policy: Map | None = None
    strategy: Map | None = None
    task: Annotated[str, Field(max_length=2000)] | None = None
    checkpoint: Checkpoint | None = None
    deadline_s: float | None = Field(default=None, gt=0, le=3600)

    @property
    def changes(self) -> dict[str, Any]:
        """Tables that override the deployment's."""
        wanted = {"policy": self.policy, "strategy": self.strategy, "task": self.task}
        return {key: value for key, value in wanted.items() if value is not None}

    @property
    def about(self) -> str:
        """Name of the checked policy, for messages."""
        named = self.checkpoint and (self.checkpoint.name or str(self.checkpoint.id))
        return f"the checkpoint {named}" if named else "the deployment's policy"


class PreflightReportRequest(Settings):
    """`preflight_report`: how the preflight of that `id` went."""

    id: Annotated[str, Field(min_length=1, max_length=200)]


class PolicyServerRequest(Settings):
    """`policy_server`: which server the policy in force has, or the deployment's with this `policy` on top."""

    policy: Map | None = None


class CollectSession(Settings):
    """The session that a collected episode is one of, and the dataset that it is meant for."""

    uuid: Annotated[str, Field(pattern=r"^[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}$")]
    dataset: Annotated[str, Field(max_length=200)] = ""


class RunRequest(Settings):
    """`run`: `trial` is the asker's own and goes into the manifest as it is; `duration_s` ends this run [s].

    Where operator, duration, mode or sim_state are absent, the deployment's own hold. `task` and `session` are for the
    mode collect, which is that of a station set up to collect.
    """

    trial: Map | None = None
    operator: Label | None = None
    duration_s: float | None = Field(default=None, gt=0)
    mode: Mode | None = None
    sim_state: Literal["live", "simulated"] | None = None
    task: Annotated[str, Field(max_length=2000)] | None = None
    session: CollectSession | None = None


class DiscardRequest(Settings):
    """`discard`: mark an episode as one that is never published; absent: the open one, which ends, or the newest."""

    episode: Annotated[str, Field(max_length=100)] | None = None


class LabelRequest(Settings):
    """`label`: how an episode went; absent: the open one, or the newest."""

    episode: Annotated[str, Field(max_length=100)] | None = None
    result: Result
    note: Annotated[str, Field(max_length=2000)] = ""


class TuneRequest(Settings):
    """`tune`: another strategy or other parameters of it, another instruction; what is absent stays as it is.

    `strategy` is merged into the one in force, whose parameters another `kind` keeps.
    """

    strategy: Map | None = None
    task: Annotated[str, Field(max_length=2000)] | None = None


Triple = Annotated[list[Annotated[float, Field(ge=-10, le=10)]], Field(min_length=3, max_length=3)]


class Jog(Settings):
    """A step of one arm's end effector: `translation` [m], `rotation` roll, pitch, yaw [rad] about fixed axes.

    Both along the axes of the arm's "base" frame, or of the end effector itself ("tool").
    """

    arm: str
    frame: Literal["base", "tool"] = "base"
    translation: Triple = Field(default_factory=lambda: [0.0, 0.0, 0.0])
    rotation: Triple = Field(default_factory=lambda: [0.0, 0.0, 0.0])


class AimRequest(Settings):
    """`aim`: where the robot would go, moving nothing.

    `joints` [D] are a target, or what a jog starts from (the commanded ones where absent, or null within); `pose` is a
    named pose.
    """

    joints: list[float | None] | None = None
    pose: str | None = None
    jog: Jog | None = None


class MoveRequest(Settings):
    """`move`: go to `joints` [D] or to a named `pose` on a limited path; a joint that is null stays where it is.

    `speed` is the part of the speed of motions of ours that may be used.
    """

    joints: list[float | None] | None = None
    pose: str | None = None
    speed: float = Field(default=1.0, ge=0.01, le=1)


class GripperRequest(Settings):
    """`gripper`: open or close one; lock one where it is, or give it back. `arm` absent: all of them."""

    arm: str | None = None
    action: Literal["open", "close", "lock", "unlock"]


# Argument model of each command. None: arguments are ignored, because a stop must never be refused for them.
ARGUMENTS: dict[str, type[Settings] | None] = {
    "setup": SetUpRequest,
    "run": RunRequest,
    "stop": None,
    "halt": None,
    "resume": Nothing,
    "home": Nothing,
    "release": Nothing,
    "record_start": Nothing,
    "record_stop": Nothing,
    "tune": TuneRequest,
    "step": Nothing,
    "commit": Nothing,
    "cancel": Nothing,
    "move": MoveRequest,
    "gripper": GripperRequest,
    "approach": Nothing,
    "arm": Nothing,
    "disarm": Nothing,
    "label": LabelRequest,
    "discard": DiscardRequest,
}
Request = TypeVar("Request", bound=Settings)


def read(kind: str, model: type[Request], arguments: Mapping[str, Any]) -> Request:
    """Return the validated arguments of a command `kind`.

    Raises:
        RuntimeFault: names the key, the given value and what is allowed.
    """
    if arguments and not model.model_fields:
        raise RuntimeFault(_TAKES_NONE(kind=kind, given=", ".join(map(str, arguments))))
    try:
        return model.model_validate(dict(arguments))
    except ValidationError as invalid:
        raise RuntimeFault(explain_validation_error(invalid, model, arguments, kind)) from None
