"""Pose rows in a deployment's format, converted only at the interfaces.

Internally an arm's vector is x, y, z [m], unit quaternion w, x, y, z, gripper, in the arm's own frame; vectors are
float64 [T, arms, 8].
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from runtime.core.errors import ConfigurationError, PolicyError
from runtime.core.pose_format import PoseFormat
from runtime.core.types import EEF_WIDTH, Float64
from runtime.spaces.frames import Frame
from runtime.spaces.orientations import (
    EulerAngles,
    Orientation,
    QuaternionOrientation,
    RotationVector,
    SixD,
    continuous_signs,
)

if TYPE_CHECKING:
    from robots import Robot


from runtime.core.types import Float32
from runtime.spaces.end_effectors import EndEffectors

_POSITION, _QUATERNION, _GRIPPER = slice(0, 3), slice(3, 7), EEF_WIDTH - 1


def orientation_of(pose: PoseFormat) -> Orientation:
    """Return the codec of the format's orientation."""
    if pose.orientation == "euler":
        return EulerAngles(pose.euler_order, pose.degrees)
    if pose.orientation == "rotation_vector":
        return RotationVector(pose.degrees)
    if pose.orientation == "6d":
        return SixD(pose.sixd == "columns")
    return QuaternionOrientation(pose.orientation == "wxyz")


class PoseRows:
    """Pose rows of a robot in one format: `width`, `names` of the numbers, `encode` and `decode`.

    `dims` are the indices, in the robot's vector, of the joints that follow the poses. `key` names the deployment's
    table in error messages.

    Raises:
        ConfigurationError: The format does not fit the robot.
    """

    def __init__(self, pose: PoseFormat, robot: Robot, key: str = "pose") -> None:
        if not robot.arms:
            raise ConfigurationError(f'{key}: {robot.name} has no end effector; allowed: the space "joint"')
        self.pose = pose
        self.frame = Frame(robot, pose.frame, key)
        self.dims = _dims(pose, robot, key)
        self._arms = [arm.name for arm in robot.arms]
        self._gripped = np.array([arm.gripper is not None for arm in robot.arms])
        self._grippers = [arm.gripper_dim for arm in robot.arms]
        self._numbers = orientation_of(pose)
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
        """Number of values in a row."""
        return len(self.names)

    @property
    def commanded(self) -> list[tuple[int, int]]:
        """Pairs (index in a row, index in the robot's vector) of the values that become commands without conversion."""
        grippers = enumerate(self._grippers if self.pose.gripper else [])
        appended = enumerate(self.dims.tolist(), len(self._arms) * self._each)
        return [((arm + 1) * self._each - 1, dim) for arm, dim in grippers if dim is not None] + [*appended]

    def encode(self, vectors: Float64, joints: Float64, previous: Float64 | None = None) -> Float64:
        """Return rows float64 [T, width] of vectors [T, arms, 8]; the frame depends on the joints [T, D] or [1, D].

        Each row is written as close to its predecessor as its orientation format permits. With `previous` [width] the
        first row is written close to it; with `previous` [T, width] each row is written close to the corresponding row.

        Raises:
            PolicyError: A quaternion is nearly zero or not a number.
        """
        upright = self.normalize_quaternions(vectors)
        appended = np.broadcast_to(joints, (len(vectors), joints.shape[-1]))[:, self.dims]
        return self.written(self.frame.express(upright, joints), appended, previous)

    def written(self, vectors: Float64, appended: Float64, previous: Float64 | None = None) -> Float64:
        """Return pose rows from the poses `vectors` and the joints `appended` [T, n] that follow them in each row.

        `vectors` must be in the frame of this format, and have unit quaternions. With `previous` [width] the first row
        is written close to it; with `previous` [T, width] each row is written close to the corresponding row.
        """
        poses = np.empty((len(vectors), len(self._arms), self._each))
        poses[..., _POSITION] = vectors[..., _POSITION]
        poses[..., self._turning] = self._turned(vectors[..., _QUATERNION], previous)
        if self.pose.gripper:
            poses[..., -1] = np.where(self._gripped, vectors[..., _GRIPPER], 0.0)
        return np.concatenate([poses.reshape(len(vectors), -1), appended], axis=1)

    def _turned(self, quaternions: Float64, previous: Float64 | None) -> Float64:
        if previous is None:
            return self._numbers.encode(quaternions)
        before = self._poses_of(np.atleast_2d(previous))[..., self._turning]
        if previous.ndim == 1:
            return self._numbers.encode(quaternions, before[0])
        encoded = self._numbers.encode(quaternions.reshape(1, -1, 4), before.reshape(-1, before.shape[-1]))
        return encoded.reshape(before.shape)

    def decode(self, rows: Float64, whose: str = "the policy answered with") -> tuple[Float64, Float64]:
        """Return vectors [T, arms, 8] in the declared frame and the joints [T, n] that follow, from rows [T, width].

        Quaternions are unit, w >= 0 in the first row, with continuous signs; a gripper that is not in the row is 0.

        Raises:
            PolicyError: Numbers determine no orientation; the message begins with `whose` and names arm and row.
        """
        poses = self._poses_of(rows)
        vectors = np.zeros((len(rows), len(self._arms), EEF_WIDTH))
        vectors[..., _POSITION] = poses[..., _POSITION]
        numbers = poses[..., self._turning]
        quaternions, determined = self._numbers.decode(numbers)
        self._require(determined, numbers, whose)
        vectors[..., _QUATERNION] = continuous_quaternions(quaternions)
        if self.pose.gripper:
            vectors[..., _GRIPPER] = np.where(self._gripped, poses[..., -1], 0.0)
        return vectors, rows[:, len(self._arms) * self._each :]

    def _poses_of(self, rows: Float64) -> Float64:
        return rows[:, : len(self._arms) * self._each].reshape(len(rows), len(self._arms), self._each)

    def normalize_quaternions(self, vectors: Float64, whose: str = "the robot measured") -> Float64:
        """Return the vectors [T, arms, 8] with unit quaternions; signs are unchanged, as a robot chooses its own.

        Raises:
            PolicyError: A quaternion is nearly zero or not a number; the message begins with `whose`.
        """
        codec = QuaternionOrientation(scalar_first=True)
        normalized = vectors.copy()
        normalized[..., _QUATERNION], determined = codec.decode(vectors[..., _QUATERNION])
        self._require(determined, vectors[..., _QUATERNION], whose, codec)
        return normalized

    def _require(
        self, determined: NDArray[np.bool_], numbers: Float64, whose: str, codec: Orientation | None = None
    ) -> None:
        if determined.all():
            return
        codec = codec or self._numbers
        row, arm = np.argwhere(~determined)[0]
        text = ", ".join(f"{number:g}" for number in numbers[row, arm])
        raise PolicyError(
            f"{whose} no orientation for {self._arms[arm]} in row {row}: {', '.join(codec.fields)} = {text}; "
            f"allowed: {codec.allowed}"
        )


def continuous_quaternions(quaternions: Float64) -> Float64:
    """Return unit quaternions [T, arms, 4] with w >= 0 in the first row and continuous signs along T."""
    continuous = quaternions.copy()
    continuous[:1] *= np.where(continuous[:1, :, :1] < 0, -1.0, 1.0)
    return continuous * continuous_signs(continuous)


def _dims(pose: PoseFormat, robot: Robot, key: str) -> NDArray[np.intp]:
    """Return the indices, in the robot's vector, of the joints that follow the poses in a row.

    They are the joints of `pose.groups`, in the declared order. `key` names the deployment's table in error messages.
    """
    plain_groups = [group.name for group in robot.groups if group.chain is None]
    for place, name in enumerate(pose.groups):
        if name not in plain_groups or name in pose.groups[:place]:
            raise ConfigurationError(
                f"{key}.groups = {pose.groups}: {name!r} cannot follow the poses; "
                f"allowed: each once of {', '.join(plain_groups) or 'none'} (groups of {robot.name} "
                "without end effector)"
            )
    chosen = [robot.group(name).slice for name in pose.groups]
    parts = [np.arange(part.start, part.stop) for part in chosen]
    return np.concatenate([np.zeros(0, np.intp), *parts])


class PosePublisher:
    """Converter of the joint commands that are sent: each command [D] becomes a pose row float32 [W].

    An orientation can often be written in several ways. The converter chooses the one that is closest to the previous
    row.
    """

    def __init__(self, rows: PoseRows, end_effectors: EndEffectors) -> None:
        self._rows = rows
        self._end_effectors = end_effectors
        self._previous: Float64 | None = None

    def __call__(self, action: Float64) -> Float32:
        joints = action[None]
        row: Float64 = self._rows.encode(self._end_effectors.vectors(joints), joints, self._previous)[0]
        self._previous = row
        return row.astype(np.float32)
