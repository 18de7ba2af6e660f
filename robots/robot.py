"""Robot as all other code uses it: groups of joints, cameras, poses, limits, one flat vector."""

from __future__ import annotations

import builtins
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robots.chain import Chain
from robots.description import CollisionTable, LerobotTable, RosTable
from robots.errors import RobotError
from robots.rotations import Float64, quaternion_of_matrix

EEF_FIELDS = ("x", "y", "z", "qw", "qx", "qy", "qz", "gripper")


@dataclass(frozen=True, slots=True)
class Gripper:
    """Gripper: one number of a group, in the robot's own `unit`; `index` is the number's position in the group.

    The number moves from `lower` to `upper`, and the gripper is open at `open` and closed at `close`. `fingers` maps
    URDF joints to their two values [rad or m], the first for `lower` and the second for `upper`. `apart` has the
    distance between the fingers [m] at `close` and at `open`; it is None if unknown. A binary gripper switches at
    `threshold`, with a `hysteresis` as a share of its travel; for other grippers both are None. `force` is the force
    with which each finger presses [N]; None if unknown.
    """

    index: int
    open: float
    close: float
    lower: float
    upper: float
    unit: str
    binary: bool
    threshold: float | None
    hysteresis: float | None
    fingers: Mapping[str, tuple[float, float]]
    apart: tuple[float, float] | None
    force: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Joints that are sent together; `joints` are their names in messages, `slice` their indices in the robot's vector.

    `urdf_joints` are the names of the same joints in the URDF, without the gripper. The name is "" for a number that
    moves no link.

    An arm has an end effector `eef_link`, whose pose is stated in `frame`. Its `chain` contains only its own joints,
    and usually begins at `frame`. If joints of other groups (a torso) lie between `frame` and the arm, they form the
    `carrier`: a chain that begins at `frame`, ends where `chain` begins, and is driven by the dimensions `carrier_dims`
    of the robot's vector.

    `mount` [7] (x, y, z, qw, qx, qy, qz) is the pose of the root of the group's URDF copy in the robot's mount frame.
    `tip` [4, 4] is the frame between the fingertips in `eef_link`, z in the direction in which they point, y in the
    opening direction; None without a gripper.
    """

    name: str
    kind: str
    joints: tuple[str, ...]
    urdf_joints: tuple[str, ...]
    gripper: Gripper | None
    eef_link: str | None
    frame: str | None
    chain: Chain | None
    carrier: Chain | None
    carrier_dims: NDArray[np.intp]
    mount: Float64
    tip: Float64 | None
    slice: builtins.slice

    @property
    def dof(self) -> int:
        """Number of the group's values, including its gripper."""
        return len(self.joints)

    @property
    def gripper_dim(self) -> int | None:
        """Index of the gripper in the robot's vector, None without one."""
        return None if self.gripper is None else int(self.slice.start) + self.gripper.index

    @property
    def joint_dims(self) -> NDArray[np.intp]:
        """Indices of `urdf_joints` in the robot's vector."""
        return _dims(self.slice.start, self.slice.stop, -1 if self.gripper is None else self.gripper.index)

    def carried(self, q: Float64) -> Float64:
        """Return the pose of the base of the group's chain in `frame`, as transforms [..., 4, 4].

        `q` is the robot's vector [..., D]. The base moves if other groups carry it; otherwise the result is the
        identity.
        """
        if self.carrier is None:
            return np.broadcast_to(np.eye(4), (*q.shape[:-1], 4, 4))
        return self.carrier.forward(q[..., self.carrier_dims])

    def transform(self, q: Float64) -> Float64:
        """Return the pose of the end effector in `frame`, as transforms [..., 4, 4], for the robot's vector [..., D].

        Raises:
            RobotError: If the group has no end effector.
        """
        if self.chain is None:
            raise RobotError(f"group {self.name} has no end effector")
        own = self.chain.forward(q[..., self.joint_dims])
        return own if self.carrier is None else self.carried(q) @ own

    def pose(self, q: Float64) -> Float64:
        """Return the pose of the end effector in `frame` [..., 7] = x, y, z [m], unit quaternion w, x, y, z with w >=
        0.
        """
        transform = self.transform(q)
        return np.concatenate([transform[..., :3, 3], quaternion_of_matrix(transform[..., :3, :3])], axis=-1)


@functools.cache
def _dims(start: int, stop: int, without: int) -> NDArray[np.intp]:
    """Return the indices from `start` to before `stop`, except the one at position `without` in that range.

    They are cached, because they are used at every step of every arm.
    """
    dims = np.array([start + place for place in range(stop - start) if place != without], dtype=np.intp)
    dims.flags.writeable = False
    return dims


@dataclass(frozen=True, slots=True)
class Camera:
    """Camera with its logical `name` and the `key` of its image in observations."""

    name: str
    key: str


@dataclass(frozen=True, slots=True, eq=False)
class Robot:
    """Robot; vectors are in the order of its groups, in rad and rad/s, grippers in their own unit.

    `lower`, `upper`, `velocity` and every pose are read-only float64 [dim]. `overrides` are sentences, one per limit
    that differs from the URDF. `mount_frame` is the frame of the mounts, and `stand` [7] its pose in the scene, whose
    table is z = 0.
    """

    name: str
    title: str
    folder: Path
    urdf: Path
    groups: tuple[Group, ...]
    cameras: tuple[Camera, ...]
    poses: dict[str, Float64]
    lower: Float64
    upper: Float64
    velocity: Float64
    control_rate: float
    limits_source: str
    overrides: tuple[str, ...]
    mount_frame: str
    stand: Float64
    collision: CollisionTable
    ros: RosTable | None
    lerobot: LerobotTable | None

    @property
    def dim(self) -> int:
        """Length of the robot's vector."""
        return sum(group.dof for group in self.groups)

    @property
    def arms(self) -> tuple[Group, ...]:
        """Groups with an end effector; each has a vector of eight numbers, the last of which is 0 without a gripper."""
        return tuple(group for group in self.groups if group.chain is not None)

    @property
    def eef_dim(self) -> int:
        """Length of the end-effector vector, 8 per arm."""
        return len(EEF_FIELDS) * len(self.arms)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Name of every number of the robot's vector, "group.joint"."""
        return tuple(f"{group.name}.{joint}" for group in self.groups for joint in group.joints)

    @property
    def eef_names(self) -> tuple[str, ...]:
        """Name of every number of the end-effector vector, "arm.x" ... "arm.qz", "arm.gripper"."""
        return tuple(f"{arm.name}.{field}" for arm in self.arms for field in EEF_FIELDS)

    @property
    def gripper_dims(self) -> tuple[int, ...]:
        """Indices of all grippers in the robot's vector."""
        return tuple(group.gripper_dim for group in self.groups if group.gripper_dim is not None)

    @property
    def binary_dims(self) -> tuple[int, ...]:
        """Indices of the binary grippers in the robot's vector."""
        binary = [group for group in self.groups if group.gripper is not None and group.gripper.binary]
        return tuple(group.gripper_dim for group in binary if group.gripper_dim is not None)

    @property
    def speed_dims(self) -> tuple[int, ...]:
        """Indices of the numbers that are speeds instead of positions, where 0 is standstill: those of a base."""
        return tuple(
            int(dim)
            for group in self.groups
            if group.kind == "base"
            for joint, dim in zip(group.urdf_joints, group.joint_dims, strict=True)
            if not joint
        )

    def group(self, name: str) -> Group:
        """Return the group with that name.

        Raises:
            RobotError: If it does not exist; the message lists the names.
        """
        for group in self.groups:
            if group.name == name:
                return group
        raise RobotError(
            f"{self.name} has no group {name!r}; it has {', '.join(g.name for g in self.groups)}"
        )

    def split(self, vector: ArrayLike) -> dict[str, NDArray[Any]]:
        """Return views [..., dof] of the vector [..., dim] by group."""
        array = np.asarray(vector)
        if array.shape[-1:] != (self.dim,):
            raise RobotError(
                f"{self.name}: a vector of shape {array.shape} was given; allowed: [..., {self.dim}]"
            )
        return {group.name: array[..., group.slice] for group in self.groups}

    def join(self, parts: Mapping[str, ArrayLike]) -> NDArray[np.float32]:
        """Return the float32 vector [..., dim] of the values [..., dof] in `parts`, which must have every group."""
        if set(parts) != {group.name for group in self.groups}:
            allowed = ", ".join(group.name for group in self.groups)
            raise RobotError(
                f"{self.name}: groups {', '.join(parts) or 'none'} were given; needed: {allowed}"
            )
        arrays = [np.asarray(parts[group.name], dtype=np.float32) for group in self.groups]
        for group, array in zip(self.groups, arrays, strict=True):
            if array.shape[-1:] != (group.dof,):
                raise RobotError(
                    f"{self.name}: group {group.name} was given {array.shape}; allowed: [..., {group.dof}]"
                )
        return np.concatenate(arrays, axis=-1)


def urdf_copies(groups: Sequence[Group]) -> list[list[Group]]:
    """Return the groups for each copy of the URDF; copies are made so that each joint is moved at most once per
    copy.
    """
    copies: list[tuple[set[str], list[Group]]] = []
    for group in groups:
        joints = {*filter(None, group.urdf_joints), *(group.gripper.fingers if group.gripper else ())}
        for used, members in copies:
            if not used & joints:
                used |= joints
                members.append(group)
                break
        else:
            copies.append((joints, [group]))
    return [members for _, members in copies]


def copy_of(group: Group, groups: Sequence[Group]) -> list[Group]:
    """Return the groups that share a copy of the URDF with `group`, including itself."""
    return next(members for members in urdf_copies(groups) if group in members)
