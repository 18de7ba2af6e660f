"""How poses are written in a row of numbers: declared in a deployment, converted at the borders alone.

Inside, an arm's vector is x, y, z [m], unit quaternion w, x, y, z, gripper, in the arm's own frame; vectors are
float64 [T, arms, 8].
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from runtime.errors import ConfigurationError, PolicyError
from runtime.frames import Frame
from runtime.orientations import (
    EulerAngles,
    Orientation,
    QuaternionNumbers,
    RotationVector,
    SixNumbers,
    continuous_signs,
)
from runtime.section import Section
from runtime.types import EEF_WIDTH, Float64

if TYPE_CHECKING:
    from robots import Robot

_POSITION, _QUATERNION, _GRIPPER = slice(0, 3), slice(3, 7), EEF_WIDTH - 1
_ORDERS = (
    r"^(xyz|xzy|yxz|yzx|zxy|zyx|xyx|xzx|yxy|yzy|zxz|zyz|XYZ|XZY|YXZ|YZX|ZXY|ZYX|XYX|XZX|YXY|YZY|ZXZ|ZYZ)$"
)
OrientationName = Literal["wxyz", "xyzw", "euler", "rotation_vector", "6d"]


class PoseFormat(Section):
    """How the pose of an end effector is written: per arm x, y, z [m], an orientation, and its gripper."""

    orientation: OrientationName = "wxyz"
    """Quaternion with the scalar first or last, Euler angles, axis times angle, or six numbers of the matrix."""
    euler_order: Annotated[str, Field(pattern=_ORDERS)] = "xyz"
    """Axes of Euler angles: "xyz" turns about fixed axes one after the other (extrinsic), "XYZ" about axes that
    turn along (intrinsic)."""
    degrees: bool = False
    """Angles of Euler angles and rotation vectors in degrees; else radians."""
    sixd: Literal["columns", "rows"] = "columns"
    """Of the rotation matrix, the first two columns one after the other, or the first two rows."""
    gripper: bool = True
    """Whether the gripper's number follows each pose (0 for an arm without one); else grippers stay as commanded."""
    frame: str = ""
    """What poses are expressed in: "" for each arm's own frame, the robot's mount frame, or a link of its URDF."""
    groups: list[str] = Field(default_factory=list)
    """Groups without end effector (a head, a torso) whose joints follow the poses; all others are held."""

    @model_validator(mode="after")
    def _mean_something(self) -> PoseFormat:
        """A key that this orientation has no use for is a mistake, and would be none to notice."""
        chosen = self.orientation
        strange = {
            "euler_order": self.euler_order != "xyz" and chosen != "euler",
            "degrees": self.degrees and chosen not in ("euler", "rotation_vector"),
            "sixd": self.sixd != "columns" and chosen != "6d",
        }
        for key, wrong in strange.items():
            if wrong:
                needed = {"euler_order": '"euler"', "degrees": '"euler" or "rotation_vector"', "sixd": '"6d"'}
                raise ValueError(
                    f"{key} = {getattr(self, key)!r} beside orientation = {chosen!r}, which has no such thing; "
                    f"allowed: with orientation = {needed[key]}, or without {key}"
                )
        return self

    @property
    def numbers(self) -> Orientation:
        """The orientation's codec."""
        if self.orientation == "euler":
            return EulerAngles(self.euler_order, self.degrees)
        if self.orientation == "rotation_vector":
            return RotationVector(self.degrees)
        if self.orientation == "6d":
            return SixNumbers(self.sixd == "columns")
        return QuaternionNumbers(self.orientation == "wxyz")

    def __str__(self) -> str:
        words: list[str] = [self.orientation]
        words += [self.euler_order] if self.orientation == "euler" else []
        words += [f"of {self.sixd}"] if self.orientation == "6d" else []
        words += ["in degrees"] if self.degrees else []
        words += [] if self.gripper else ["without gripper"]
        words += [f"in {self.frame}"] if self.frame else []
        words += [f"with {', '.join(self.groups)}"] if self.groups else []
        return " ".join(words)


CANONICAL = PoseFormat()


def refuse_format(pose: PoseFormat, key: str) -> None:
    """ConfigurationError where a format is declared for a space that is joints: it would mean nothing."""
    given = pose.model_dump(exclude_defaults=True)
    if given:
        raise ConfigurationError(
            f'{key} = {given}, but the space it is for is "joint"; allowed: no format, or the space "eef"'
        )


class PoseRows:
    """Rows of poses for one robot in one format: their `width`, the `names` of their numbers, and the way both ways.

    `dims` are the places in the robot's vector of the joints that follow the poses. `key` names the table of the
    deployment in errors. ConfigurationError where the format does not fit the robot.
    """

    def __init__(self, pose: PoseFormat, robot: Robot, key: str = "pose") -> None:
        if not robot.arms:
            raise ConfigurationError(f'{key}: {robot.name} has no end effector; allowed: the space "joint"')
        self.pose = pose
        self.frame = Frame(robot, pose.frame, key)
        self.dims = _dims(pose, robot, key)
        self._arms = [arm.name for arm in robot.arms]
        self._gripped = np.array([arm.gripper is not None for arm in robot.arms])
        self._numbers = pose.numbers
        self._turning = slice(3, 3 + len(self._numbers.fields))
        fields = ("x", "y", "z", *self._numbers.fields, *(("gripper",) if pose.gripper else ()))
        self._each = len(fields)
        joints = robot.joint_names
        self.names = (
            *(f"{arm}.{field}" for arm in self._arms for field in fields),
            *(joints[dim] for dim in self.dims),
        )

    @property
    def width(self) -> int:
        """Numbers per row."""
        return len(self.names)

    def encode(self, vectors: Float64, joints: Float64, previous: Float64 | None = None) -> Float64:
        """Rows float64 [T, width] of vectors [T, arms, 8] at the joints [T or 1, D], which place the frame.

        Each row is as near to the one before as its orientations can be written, the first to `previous` [width].
        Raises PolicyError for a quaternion without direction.
        """
        upright = self.upright(vectors)
        turned = self.frame.express(upright, joints)
        before = None if previous is None else self._poses_of(previous[None])[0, :, self._turning]
        poses = np.empty((len(vectors), len(self._arms), self._each))
        poses[..., _POSITION] = turned[..., _POSITION]
        poses[..., self._turning] = self._numbers.encode(turned[..., _QUATERNION], before)
        if self.pose.gripper:
            poses[..., -1] = np.where(self._gripped, turned[..., _GRIPPER], 0.0)
        appended = np.broadcast_to(joints, (len(vectors), joints.shape[-1]))[:, self.dims]
        return np.concatenate([poses.reshape(len(vectors), -1), appended], axis=1)

    def decode(self, rows: Float64, whose: str = "the policy answered with") -> tuple[Float64, Float64]:
        """Vectors [T, arms, 8] in the declared frame and the joints [T, n] that follow them, of rows [T, width].

        Quaternions are unit, w >= 0 in the first row, their signs continuous; a gripper that is not in the row is
        0. PolicyError names arm and row of numbers that determine no orientation; `whose` begins its sentence.
        """
        poses = self._poses_of(rows)
        vectors = np.zeros((len(rows), len(self._arms), EEF_WIDTH))
        vectors[..., _POSITION] = poses[..., _POSITION]
        given = poses[..., self._turning]
        quaternions, determined = self._numbers.decode(given)
        self._require(determined, given, whose)
        vectors[..., _QUATERNION] = continuous(quaternions)
        if self.pose.gripper:
            vectors[..., _GRIPPER] = np.where(self._gripped, poses[..., -1], 0.0)
        return vectors, rows[:, len(self._arms) * self._each :]

    def _poses_of(self, rows: Float64) -> Float64:
        return rows[:, : len(self._arms) * self._each].reshape(len(rows), len(self._arms), self._each)

    def upright(self, vectors: Float64, whose: str = "the robot measured") -> Float64:
        """The vectors [T, arms, 8] with unit quaternions; signs are kept: those that a robot measures are its own.

        Raises PolicyError for a quaternion without direction.
        """
        codec = QuaternionNumbers(scalar_first=True)
        made = vectors.copy()
        made[..., _QUATERNION], determined = codec.decode(vectors[..., _QUATERNION])
        self._require(determined, vectors[..., _QUATERNION], whose, codec)
        return made

    def _require(
        self, determined: NDArray[np.bool_], given: Float64, whose: str, codec: Orientation | None = None
    ) -> None:
        if determined.all():
            return
        codec = codec or self._numbers
        row, arm = np.argwhere(~determined)[0]
        found = ", ".join(f"{number:g}" for number in given[row, arm])
        raise PolicyError(
            f"{whose} no orientation for {self._arms[arm]} in row {row}: {', '.join(codec.fields)} = {found}; "
            f"allowed: {codec.allowed}"
        )


def continuous(quaternions: Float64) -> Float64:
    """Unit quaternions [T, arms, 4] with w >= 0 in the first row and signs continuous along T."""
    made = quaternions.copy()
    made[:1] *= np.where(made[:1, :, :1] < 0, -1.0, 1.0)
    return made * continuous_signs(made)


def _dims(pose: PoseFormat, robot: Robot, key: str) -> NDArray[np.intp]:
    """The places of the appended groups' joints in the robot's vector, in the order in which they are named."""
    others = [group.name for group in robot.groups if group.chain is None]
    for place, name in enumerate(pose.groups):
        if name not in others or name in pose.groups[:place]:
            raise ConfigurationError(
                f"{key}.groups = {pose.groups}: {name!r} cannot follow the poses; "
                f"allowed: each once of {', '.join(others) or 'none'} (groups of {robot.name} without end effector)"
            )
    chosen = [robot.group(name).slice for name in pose.groups]
    parts = [np.arange(part.start, part.stop) for part in chosen]
    return np.concatenate([np.zeros(0, np.intp), *parts])
