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


def _small(value: dict[str, JsonValue]) -> dict[str, JsonValue]:
    size = len(json.dumps(value))
    if size > LARGEST:
        raise ValueError(f"must be at most {LARGEST} characters of JSON, and is {size}")
    return value


Map = Annotated[dict[str, JsonValue], AfterValidator(_small)]
Label = Annotated[str, Field(max_length=200)]


class Nothing(Settings):
    """Empty arguments, for commands without parameters."""


class Checkpoint(Settings):
    """Identity of the policy's checkpoint, as known to the requester."""

    id: Annotated[str, Field(min_length=1, max_length=200)] | int
    name: Label = ""


Place = Annotated[list[float], Field(min_length=2, max_length=3)]


class BenchRequest(Settings):
    """Requested layout of a simulated bench; `id` names this reset, and is generated if absent.

    `positions` are the places of the bench's objects by name in the world frame: x, y [m] and, of objects that can be
    turned, yaw [degrees]. Objects without a place are laid anywhere. `factors` are values of the bench's factors by
    name, and `choices` those of its choices; the others are as usual. The bench's own schema decides what it accepts.
    `of` is the bench that the layout belongs to, by name or folder, and `schema_digest` the digest of its schema;
    absent, any bench that accepts it.
    """

    id: Annotated[str, Field(min_length=1, max_length=200)] | None = None
    seed: int = Field(ge=0, le=_HIGHEST_SEED)
    positions: Annotated[dict[str, Place], Field(max_length=100)] | None = None
    factors: Annotated[dict[str, float], Field(max_length=20)] | None = None
    choices: Annotated[dict[str, Label], Field(max_length=20)] | None = None
    of: Annotated[str, Field(min_length=1, max_length=200)] | None = None
    schema_digest: Annotated[str, Field(max_length=80)] | None = None


class LeastTimes(Settings):
    """Minimum durations [s] of the set-up stages that wait for the policy; a faster policy waits for the rest."""

    connect_s: float = Field(default=0.0, ge=0, le=3600)
    warm_up_s: float = Field(default=0.0, ge=0, le=3600)


class SetUpRequest(Settings):
    """Arguments of `setup`: changes of the deployment for this set-up; absent keys keep the deployment's values.

    `policy` is merged over the deployment's [policy], or replaces it completely if its `kind` is another. `checkpoint`
    is only recorded. With `collect` a person drives the robot, according to the deployment's [collection]; if it is
    absent, a person drives only if the deployment has no policy. `least` are minimum durations of the set-up's stages,
    so that two policies cannot be told apart by them.
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
        changes = {"policy": self.policy, "strategy": self.strategy, "task": self.task}
        return {key: value for key, value in changes.items() if value is not None}


class PreflightRequest(Settings):
    """Arguments of `preflight`: policy to query without the robot; absent keys keep the deployment's values.

    `policy` and `strategy` are as in a set-up; `id` names the report. The preflight ends after `deadline_s` [s] at the
    latest; if it is absent, after the sum of the policy's own deadlines.
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
        changes = {"policy": self.policy, "strategy": self.strategy, "task": self.task}
        return {key: value for key, value in changes.items() if value is not None}

    @property
    def about(self) -> str:
        """Name of the checked policy, for messages."""
        named = self.checkpoint and (self.checkpoint.name or str(self.checkpoint.id))
        return f"the checkpoint {named}" if named else "the deployment's policy"


class PreflightReportRequest(Settings):
    """`preflight_report`: the report of the preflight with that `id`."""

    id: Annotated[str, Field(min_length=1, max_length=200)]


class PolicyServerRequest(Settings):
    """`policy_server`: server of the policy in force, or of the deployment's merged with `policy`."""

    policy: Map | None = None


class CollectSession(Settings):
    """Session of a collected episode, and the dataset for which it is recorded."""

    uuid: Annotated[str, Field(pattern=r"^[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}$")]
    dataset: Annotated[str, Field(max_length=200)] = ""


class RunRequest(Settings):
    """Arguments of `run`; absent keys keep the deployment's values.

    `trial` is copied to the manifest unchanged. The run ends after `duration_s` [s] at the latest. `task` and `session`
    are for the mode "collect" of a station that was set up to collect.
    """

    trial: Map | None = None
    operator: Label | None = None
    duration_s: float | None = Field(default=None, gt=0)
    mode: Mode | None = None
    sim_state: Literal["live", "simulated"] | None = None
    task: Annotated[str, Field(max_length=2000)] | None = None
    session: CollectSession | None = None


class DiscardRequest(Settings):
    """Arguments of `discard`, which marks an episode as never to be published.

    Without `episode` it is the open episode, which ends; if none is open, the newest one.
    """

    episode: Annotated[str, Field(max_length=100)] | None = None


class LabelRequest(Settings):
    """Arguments of `label`: the outcome of an episode.

    Without `episode` it is the open episode; if none is open, the newest one.
    """

    episode: Annotated[str, Field(max_length=100)] | None = None
    result: Result
    note: Annotated[str, Field(max_length=2000)] = ""


class TuneRequest(Settings):
    """Arguments of `tune`: another strategy, other parameters, or another instruction; absent keys stay unchanged.

    `strategy` is merged over the present one; its parameters are kept even if the `kind` changes.
    """

    strategy: Map | None = None
    task: Annotated[str, Field(max_length=2000)] | None = None


Triple = Annotated[list[Annotated[float, Field(ge=-10, le=10)]], Field(min_length=3, max_length=3)]


class Jog(Settings):
    """Step of one arm's end effector: `translation` [m], `rotation` as roll, pitch, yaw [rad] about fixed axes.

    Both are along the axes of the arm's frame ("base"), or of the end effector itself ("tool").
    """

    arm: str
    frame: Literal["base", "tool"] = "base"
    translation: Triple = Field(default_factory=lambda: [0.0, 0.0, 0.0])
    rotation: Triple = Field(default_factory=lambda: [0.0, 0.0, 0.0])


class AimRequest(Settings):
    """Arguments of `aim`: preview of a motion; nothing moves.

    `joints` [D] are the target, or the start of a jog; joints that are absent or null are at their commanded positions.
    `pose` is a named pose.
    """

    joints: list[float | None] | None = None
    pose: str | None = None
    jog: Jog | None = None


class MoveRequest(Settings):
    """Arguments of `move`: target `joints` [D] or a named `pose`; joints that are null do not move.

    `speed` is a share of the speed of the station's own motions.
    """

    joints: list[float | None] | None = None
    pose: str | None = None
    speed: float = Field(default=1.0, ge=0.01, le=1)


class GripperRequest(Settings):
    """`gripper`: open, close, lock or unlock a gripper; without `arm`: all grippers."""

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
