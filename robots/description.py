"""Contents of a robot.toml: one model per table, strict, every key documented."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError

from robots.errors import RobotError

Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
Pair = Annotated[list[float], Field(min_length=2, max_length=2)]
Triple = Annotated[list[float], Field(min_length=3, max_length=3)]
Quadruple = Annotated[list[float], Field(min_length=4, max_length=4)]
Positive = Annotated[float, Field(gt=0)]
Reason = Annotated[str, Field(min_length=1)]
Label = Annotated[str, Field(min_length=1)]  # of a joint: what the wire or the URDF calls it
Topic = Annotated[str, Field(pattern=r"^[~/A-Za-z][A-Za-z0-9_/~]*$")]
Kind = Literal["arm", "hand", "head", "torso", "base", "other"]
TABLE = "table"  # in pairs of [collision]: the plane z = 0 of the scene


class Table(BaseModel):
    """A table of robot.toml: nothing is coerced, unknown keys are errors that list the known ones."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _know_every_key(cls, given: Any) -> Any:
        unknown = sorted(set(given) - set(cls.model_fields)) if isinstance(given, dict) else []
        if unknown:
            raise PydanticCustomError(
                "unknown_key",
                "unknown key {unknown}; allowed: {allowed}",
                {"unknown": ", ".join(unknown), "allowed": ", ".join(cls.model_fields)},
            )
        return given


class TipTable(Table):
    """A frame in `eef_link` between the fingertips: z the way they point, y the way they open."""

    xyz: Triple
    wxyz: Quadruple


class GripperTable(Table):
    """A group's gripper, one number in the robot's own unit."""

    index: Annotated[int, Field(ge=0)]
    """Its place inside the group, from 0."""
    unit: Annotated[str, Field(min_length=1)]
    """The unit of its number on the wire."""
    lower: float
    upper: float
    open: float
    close: float
    velocity: Positive
    """In units per second."""
    binary: bool = False
    """Whether it knows only open and close."""
    threshold: float | None = None
    """Where a binary gripper switches; a value at or above it means open if `open` is above `close`."""
    hysteresis: Annotated[float, Field(ge=0, lt=1)] | None = None
    """Around the threshold, the part of its travel within which a binary gripper stays as it was; 0.05 where it is
    not given, less where the threshold is nearer to an end than that."""
    fingers: dict[str, Pair] = {}
    """URDF joints that move with it: their values [rad or m] at `lower` and at `upper`; drawing only."""
    apart: Pair | None = None
    """How far its fingers are apart [m] at `close` and at `open`; else the number itself where `unit` is "m"."""
    tip: TipTable | None = None
    """Where its fingertips are; else read off the fingers of the URDF, the sliding children of `eef_link`."""


class PlaceTable(Table):
    """Place of an object."""

    xyz: Triple
    wxyz: Quadruple


class CapsuleTable(Table):
    """A capsule that stands for a link in the collision check, in the link's frame [m]."""

    start: Triple
    end: Triple
    radius: Positive


def _several(given: Any) -> Any:
    return [given] if isinstance(given, dict) else given


Capsules = Annotated[list[CapsuleTable], BeforeValidator(_several), Field(min_length=1)]


class CollisionTable(Table):
    """Input of the coarse collision check; without it, capsules from the shapes of each link."""

    capsules: dict[str, Capsules] = {}
    """Links with a capsule of their own, or a list of some, instead of those that their shapes give."""
    without: list[str] = []
    """Links that are left out: fingers that touch each other, covers, cameras."""
    ignore: list[Annotated[list[str], Field(min_length=2, max_length=2)]] = []
    """Pairs that may come close: links of one copy of the URDF, "table", or GROUP/LINK for links of two arms.

    Neighbours beyond one joint, and pairs that touch at every posture, are left out anyway."""


class RosGroupTable(Table):
    """The topics of one group; what is absent the robot's stack does not have."""

    state: Topic | None = None
    command: Topic | None = None
    eef: Topic | None = None
    eef_command: Topic | None = None
    gripper_state: Topic | None = None
    gripper_command: Topic | None = None
    simulation: Topic | None = None
    leader: Topic | None = None


class RosTable(Table):
    """The topics of the robot's own ROS stack."""

    version: Literal[1, 2]
    cameras: dict[Name, Topic] = {}
    """Logical camera name = topic."""
    groups: dict[Name, RosGroupTable] = {}


class OverrideTable(Table):
    """Limits that replace the URDF's for one joint, and why."""

    joint: Label
    lower: float | None = None
    upper: float | None = None
    velocity: Positive | None = None
    reason: Reason


class GroupTable(Table):
    """Joints that travel together on the wire, in this order."""

    name: Name
    joints: Annotated[list[Label], Field(min_length=1)]
    """Names on the wire, the gripper's included."""
    urdf_joints: list[str]
    """Their names in the URDF, in the same order, without the gripper; "" for a number that moves no link of it
    (a base's speed), whose limits are then an override."""
    kind: Kind | None = None
    """What it is, for pages; "arm" where it has an end effector, else "other"."""
    optional: bool = False
    """Part of the robot only where a deployment's `groups` names it."""
    gripper: GripperTable | None = None
    frame: str | None = None
    """The link in which the end effector's pose is expressed."""
    eef_link: str | None = None
    """The link that is the end effector."""
    pinned: dict[str, float] = {}
    """Values of URDF joints between `frame` and `eef_link` that no group moves (a frozen torso)."""
    mount: PlaceTable | None = None
    """Where the root of its copy of the URDF stands in `mount_frame`."""
    overrides: list[OverrideTable] = []


class RobotTable(Table):
    """The whole robot.toml."""

    title: Annotated[str, Field(min_length=1)]
    urdf: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+\.urdf$")]
    """File name of the URDF in the same folder."""
    limits_source: Reason
    """Where the joint limits come from."""
    control_rate: Positive
    """Commands per second that the robot is run at unless a deployment says otherwise."""
    cameras: dict[Name, Name]
    """Logical name = observation key."""
    mount_frame: Name = "world"
    """Name of the frame in which mounts are given: one that all arms have in common."""
    stand: PlaceTable | None = None
    """Where `mount_frame` stands in the scene, whose z = 0 is the table: drawings and the simulated bench."""
    collision: CollisionTable = CollisionTable()
    ros: RosTable | None = None
    groups: Annotated[list[GroupTable], Field(min_length=1)]
    poses: dict[Name, dict[str, list[float]]]
    """Named poses, a vector per group; "home" is required."""


def read(path: Path) -> RobotTable:
    """The tables of the file; RobotError lists every wrong key with what was given and what is allowed."""
    try:
        with path.open("rb") as file:
            given = tomllib.load(file)
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise RobotError(f"{path}: cannot be read as TOML: {error}") from error
    try:
        return RobotTable.model_validate(given)
    except ValidationError as error:
        sentences = "\n".join(f"{path}: {_sentence(detail)}" for detail in error.errors())
        raise RobotError(sentences) from error


def _sentence(detail: ErrorDetails) -> str:
    key = ".".join(str(part) for part in detail["loc"]) or "top level"
    if detail["type"] == "unknown_key":
        return f"{key}: {detail['msg']}"
    if detail["type"] == "missing":
        return f"{key}: required and absent"
    return f"{key} = {detail['input']!r}: {detail['msg']}"
