"""Kinematic chain from a frame to a tip: forward kinematics and geometric Jacobian."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from robots.errors import RobotError
from robots.rotations import Float64, quaternion_of_matrix
from robots.urdf import Joint, Urdf

_NEXT = np.array([1, 2, 0])
_AFTER = np.array([2, 0, 1])


@dataclass(frozen=True, slots=True, eq=False)
class MovingJoint:
    """Joint that rotates about the unit vector `axis` [3], or moves along it if it `slides`.

    Its value is factor * q[drive] + offset. `origin` [4, 4] is its pose relative to the previous moving joint at the
    value 0.
    """

    origin: Float64
    axis: Float64
    slides: bool
    drive: int
    factor: float
    offset: float


class Chain:
    """Chain between two links of a URDF, driven by `joints` [n] (rad; prismatic: m); all other joints are pinned.

    The transform of each moving joint is linear in (1, cos v, sin v, v), so that all transforms follow from one product
    with a precomputed table. A mimic joint is driven by the joint that it follows.

    Raises:
        RobotError: If a joint on the path is neither driven, pinned nor a mimic of such a joint, or a driven joint
            moves nothing.
    """

    def __init__(
        self,
        urdf: Urdf,
        frame: str,
        tip: str,
        joints: Sequence[str],
        pinned: Mapping[str, float] | None = None,
    ) -> None:
        self.frame = frame
        self.tip = tip
        self.joints = tuple(joints)
        self.pinned = dict(pinned or {})
        self._path = urdf.path
        self._build(urdf, self.pinned)

    @property
    def size(self) -> int:
        """Number of values that drive the chain."""
        return len(self.joints)

    @property
    def moving(self) -> tuple[MovingJoint, ...]:
        """Moving joints, from the frame outwards."""
        return tuple(
            MovingJoint(
                origin=(table[0] + table[1]).reshape(4, 4),
                axis=axis[:, 0],
                slides=bool(slides[0]),
                drive=(drive := int(np.flatnonzero(row)[0])),
                factor=float(row[drive]),
                offset=float(offset),
            )
            for table, axis, slides, row, offset in zip(
                self._table, self._axes, self._slides, self._coupling, self._offsets, strict=True
            )
        )

    @property
    def tail(self) -> Float64:
        """Transform from the last moving joint to the tip [4, 4]."""
        return self._tail

    def forward(self, q: Float64) -> Float64:
        """Return the pose of the tip in the chain's first frame as transforms [..., 4, 4], for joints [..., n]."""
        steps = self._steps(q)
        transform = steps[..., 0, :, :]
        for index in range(1, steps.shape[-3]):
            transform = transform @ steps[..., index, :, :]
        tip: Float64 = transform @ self._tail
        return tip

    def pose(self, q: Float64) -> Float64:
        """Return the pose of the tip in the frame [..., 7] = x, y, z [m], unit quaternion w, x, y, z with w >= 0."""
        tip = self.forward(q)
        pose = np.empty((*tip.shape[:-2], 7))
        pose[..., :3] = tip[..., :3, 3]
        pose[..., 3:] = quaternion_of_matrix(tip[..., :3, :3])
        return pose

    def jacobian(self, q: Float64) -> tuple[Float64, Float64]:
        """Return the pose of the tip [4, 4] and its Jacobian [6, n] at joints `q` [n].

        The Jacobian is d(position, rotation vector)/dq in the axes of the frame.
        """
        steps = self._steps(q)
        frames = np.empty_like(steps)
        frames[0] = steps[0]
        for index in range(1, len(steps)):
            np.matmul(frames[index - 1], steps[index], out=frames[index])
        tip = frames[-1] @ self._tail
        # Rotation about its own axis does not move a joint's axis and origin.
        axes = (frames[:, :3, :3] @ self._axes)[..., 0]
        arms = tip[:3, 3] - frames[:, :3, 3]
        turns = axes[:, _NEXT] * arms[:, _AFTER] - axes[:, _AFTER] * arms[:, _NEXT]
        columns = np.empty((6, len(steps)))
        columns[:3] = np.where(self._slides, axes, turns).T
        columns[3:] = np.where(self._slides, 0.0, axes).T
        return tip, columns if self._plain else columns @ self._coupling

    def _steps(self, q: Float64) -> Float64:
        """Return the transform of each moving joint relative to the previous one, [..., moving joints, 4, 4].

        Each includes the fixed joints in between.
        """
        if q.shape[-1:] != (self.size,):
            raise RobotError(
                f"{self._path}: the chain {self.frame} to {self.tip} was given joints of shape {q.shape}; "
                f"allowed: [..., {self.size}] for {', '.join(self.joints)}"
            )
        values = q if self._plain else q @ self._coupling.T + self._offsets
        return motions(values, self._table)

    def _build(self, urdf: Urdf, pinned: Mapping[str, float]) -> None:
        tables, axes, slides, rows, offsets = [], [], [], [], []
        fixed = np.eye(4)
        for joint in urdf.between(self.frame, self.tip):
            fixed = fixed @ joint.origin
            if joint.kind == "fixed":
                continue
            row, offset = self._drive(urdf, joint, pinned)
            table = motion_table(fixed, joint)
            if not row.any():
                fixed = np.tensordot([1.0, np.cos(offset), np.sin(offset), offset], table, axes=1).reshape(
                    4, 4
                )
                continue
            tables.append(table)
            axes.append(joint.axis)
            slides.append(joint.kind == "prismatic")
            rows.append(row)
            offsets.append(offset)
            fixed = np.eye(4)
        self._tail = fixed
        self._coupling = np.array(rows).reshape(-1, self.size)
        idle = [name for index, name in enumerate(self.joints) if not self._coupling[:, index].any()]
        if idle or not self.joints:
            raise RobotError(
                f"{urdf.path}: {idle or 'no joint'} on the way from {self.frame} to {self.tip} moves it"
            )
        self._table = np.array(tables)  # [moving, 4, 16]
        self._axes = np.array(axes)[..., None]  # [moving, 3, 1]
        self._slides = np.array(slides)[:, None]
        self._offsets = np.array(offsets)
        square = len(rows) == self.size
        self._plain = square and bool((self._coupling == np.eye(self.size)).all()) and not self._offsets.any()

    def _drive(self, urdf: Urdf, joint: Joint, pinned: Mapping[str, float]) -> tuple[Float64, float]:
        """Return how the vector q that drives the chain determines the value of a joint.

        The value is row . q + offset; the method returns row [n] and offset. A mimic joint is followed to the joint
        that it mimics. `pinned` has the constant values of joints that nothing drives.
        """
        row = np.zeros(self.size)
        factor, offset = 1.0, 0.0
        names = [joint.name]
        while joint.mimic and joint.name not in self.joints and joint.name not in pinned:
            offset += factor * joint.mimic.offset
            factor *= joint.mimic.multiplier
            joint = urdf.joint(joint.mimic.joint)
            if joint.name in names:
                raise RobotError(f"{urdf.path}: joints {', '.join(names)} mimic each other in a circle")
            names.append(joint.name)
        if joint.name in self.joints:
            row[self.joints.index(joint.name)] = factor
            return row, offset
        if joint.name not in pinned:
            raise RobotError(
                f"{urdf.path}: joint {joint.name!r} lies between {self.frame} and {self.tip}, not driven; "
                "name it among the group's urdf_joints or give its value under pinned"
            )
        return row, offset + factor * pinned[joint.name]


def motion_table(fixed: Float64, joint: Joint) -> Float64:
    """Return four matrices [4, 16] whose sum, weighted by (1, cos v, sin v, v), is `fixed` times the joint's motion.

    A rotation about the unit vector a is a a^T + (I - a a^T) cos v + [a]x sin v (Rodrigues).
    """
    table = np.zeros((4, 4, 4))
    if joint.kind == "prismatic":
        table[0] = np.eye(4)
        table[3, :3, 3] = joint.axis
    else:
        x, y, z = joint.axis
        along = np.outer(joint.axis, joint.axis)
        table[0, :3, :3], table[0, 3, 3] = along, 1.0
        table[1, :3, :3] = np.eye(3) - along
        table[2, :3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    return np.asarray(fixed @ table).reshape(4, 16)


def motions(values: Float64, tables: Float64) -> Float64:
    """Return the transforms [..., N, 4, 4] of joints with the given values [..., N] and motion tables [N, 4, 16]."""
    terms = np.empty((*values.shape, 1, 4))
    terms[..., 0, 0] = 1.0
    terms[..., 0, 1] = np.cos(values)
    terms[..., 0, 2] = np.sin(values)
    terms[..., 0, 3] = values
    return np.asarray(terms @ tables).reshape(*values.shape, 4, 4)
