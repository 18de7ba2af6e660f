"""Schema of robot.toml: one strict model per table, with every key documented."""

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
Label = Annotated[str, Field(min_length=1)]  # name of a joint on the wire or in the URDF
Topic = Annotated[str, Field(pattern=r"^[~/A-Za-z][A-Za-z0-9_/~]*$")]
Kind = Literal["arm", "hand", "head", "torso", "base", "other"]
TABLE = "table"  # name in pairs of [collision]: the plane z = 0 of the scene


class Table(BaseModel):
    """Table of robot.toml: values are not converted, and unknown keys are errors that list the known ones."""

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
    """Frame between the fingertips, relative to `eef_link`.

    Its z axis is the direction in which the fingertips point. Its y axis is the direction in which the fingers open.
    """

    xyz: Triple
    wxyz: Quadruple


class GripperTable(Table):
    """Gripper of a group: one number in the robot's own unit."""

    index: Annotated[int, Field(ge=0)]
    """Index in the group, from 0."""
    unit: Annotated[str, Field(min_length=1)]
    """Unit of the number on the wire."""
    lower: float
    upper: float
    open: float
    close: float
    velocity: Positive
    """[unit/s]"""
    binary: bool = False
    """Whether it can only open and close."""
    threshold: float | None = None
    """Value at which a binary gripper switches; values at or above it mean open if `open` is above `close`."""
    hysteresis: Annotated[float, Field(ge=0, lt=1)] | None = None
    """Share of the travel, around the threshold, within which a binary gripper keeps its state. Default:
    0.05, or less if the threshold is closer to an end.
    """
    fingers: dict[str, Pair] = {}
    """URDF joints that move with it: their values [rad or m] at `lower` and at `upper`; for drawing only."""
    apart: Pair | None = None
    """Distance of the fingers [m] at `close` and at `open`. Default: the number itself if `unit` is "m"."""
    force: Positive | None = None
    """Force with which each finger presses [N]; for the bench with contact forces only."""
    tip: TipTable | None = None
    """Frame of the fingertips. Default: derived from the fingers of the URDF, the sliding children of `eef_link`."""


class PlaceTable(Table):
    """Pose of an object."""

    xyz: Triple
    wxyz: Quadruple


class CapsuleTable(Table):
    """Capsule that approximates a link in the collision check, in the link's frame [m]."""

    start: Triple
    end: Triple
    radius: Positive
    finger: bool = False
    """Whether it is a finger that does not move with its gripper: fingers may come down to the table."""


def _several(value: Any) -> Any:
    return [value] if isinstance(value, dict) else value


Capsules = Annotated[list[CapsuleTable], BeforeValidator(_several), Field(min_length=1)]


class CollisionTable(Table):
    """Input of the coarse collision check. Default: capsules from the shapes of each link."""

    capsules: dict[str, Capsules] = {}
    """Links with declared capsules, one or a list, instead of those from their shapes."""
    without: list[str] = []
    """Links excluded from the check: fingers that touch each other, covers, cameras."""
    ignore: list[Annotated[list[str], Field(min_length=2, max_length=2)]] = []
    """Pairs that may come close: links of one copy of the URDF, "table", or GROUP/LINK for links of two arms.
    Neighbours up to one joint apart, and pairs that touch at every posture, are always excluded.
    """


class RosGroupTable(Table):
    """Topics of one group; absent ones do not exist in the robot's ROS stack."""

    state: Topic | None = None
    command: Topic | None = None
    eef: Topic | None = None
    eef_command: Topic | None = None
    gripper_state: Topic | None = None
    gripper_command: Topic | None = None
    simulation: Topic | None = None
    leader: Topic | None = None


class RosTable(Table):
    """Topics of the robot's own ROS stack."""

    version: Literal[1, 2]
    cameras: dict[Name, Topic] = {}
    """Logical camera name = topic."""
    groups: dict[Name, RosGroupTable] = {}


class LerobotJointTable(Table):
    """Feature of a LeRobot device that is one joint of ours; its numbers are converted linearly."""

    feature: Label
    """Name of the feature in the device's observations and actions, such as "shoulder_pan.pos"."""
    unit: Literal["same", "degrees"] = "same"
    """Unit of the device's numbers: that of the robot's description, or degrees for a joint in rad."""
    theirs: Pair | None = None
    """Two different numbers of the device, instead of `unit`."""
    ours: Pair | None = None
    """The numbers of ours that `theirs` are."""

    @model_validator(mode="after")
    def _two_ranges(self) -> LerobotJointTable:
        ranges = [pair for pair in (self.theirs, self.ours) if pair is not None]
        wide = all(first != last for first, last in ranges)
        if len(ranges) == 1 or not wide or (ranges and self.unit != "same"):
            raise PydanticCustomError(
                "ranges",
                "allowed: `unit`, or both `theirs` and `ours` with two different numbers each",
            )
        return self


class LerobotTable(Table):
    """LeRobot's names and units of the robot, for LeRobot's own driver of it."""

    joints: dict[Name, dict[Label, LerobotJointTable]] = {}
    """Group = joint of the group = feature."""


class OverrideTable(Table):
    """Limits that replace the URDF's for one joint, with the reason."""

    joint: Label
    lower: float | None = None
    upper: float | None = None
    velocity: Positive | None = None
    reason: Reason


class GroupTable(Table):
    """Joints that are sent together on the wire, in this order."""

    name: Name
    joints: Annotated[list[Label], Field(min_length=1)]
    """Names on the wire, including the gripper."""
    urdf_joints: list[str]
    """Names in the URDF, in the same order, without the gripper; "" for a number that moves no link (speed of
    a base), whose limits must be an override.
    """
    kind: Kind | None = None
    """Kind of group, for pages. Default: "arm" with an end effector, else "other"."""
    optional: bool = False
    """Whether it is part of the robot only if a deployment's `groups` names it."""
    gripper: GripperTable | None = None
    frame: str | None = None
    """Link in which the end effector's pose is expressed."""
    eef_link: str | None = None
    """Link that is the end effector."""
    pinned: dict[str, float] = {}
    """Values of URDF joints between `frame` and `eef_link` that no group moves (a fixed torso)."""
    mount: PlaceTable | None = None
    """Pose of the root of its copy of the URDF in `mount_frame`."""
    overrides: list[OverrideTable] = []


class RobotTable(Table):
    """Complete robot.toml."""

    title: Annotated[str, Field(min_length=1)]
    urdf: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+\.urdf$")]
    """File name of the URDF in the same folder."""
    limits_source: Reason
    """Origin of the joint limits."""
    control_rate: Positive
    """Default number of commands per second [Hz]; a deployment may override it."""
    cameras: dict[Name, Name]
    """Logical name = observation key."""
    mount_frame: Name = "world"
    """Name of the frame in which mounts are given, common to all arms."""
    stand: PlaceTable | None = None
    """Pose of `mount_frame` in the scene, whose table is z = 0: for drawings and the simulated bench."""
    collision: CollisionTable = CollisionTable()
    ros: RosTable | None = None
    lerobot: LerobotTable | None = None
    groups: Annotated[list[GroupTable], Field(min_length=1)]
    poses: dict[Name, dict[str, list[float]]]
    """Named poses, one vector per group; "home" is required."""


def read(path: Path) -> RobotTable:
    """Return the tables of the file.

    Raises:
        RobotError: If the file is invalid; it lists every wrong key with the given and the allowed values.
    """
    try:
        with path.open("rb") as file:
            document = tomllib.load(file)
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise RobotError(f"{path}: cannot be read as TOML: {error}") from error
    try:
        return RobotTable.model_validate(document)
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
