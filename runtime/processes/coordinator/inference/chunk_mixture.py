"""Mixtures of several chunks, in the policy's own number format."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from runtime.core.errors import PolicyError
from runtime.core.pose_format import CANONICAL
from runtime.core.types import EEF_WIDTH, ActionChunk, Float64, Observation
from runtime.kinematics.base import ChainForward
from runtime.motion.timeline import DimensionKinds, difference
from runtime.spaces.end_effectors import EndEffectors
from runtime.spaces.pose_rows import PoseRows
from runtime.spaces.relative_poses import relative

if TYPE_CHECKING:
    from robots import Robot

_ROUND = 0.02  # [rad] by which linearly mixed model rows may deviate in an angle or rotation


class MixtureParts(NamedTuple):
    """Components of N mixed rows, to each of which P chunks contribute.

    `rows` [P, N, W] are the chunks' numbers, `weights` [P, N] sum to 1 over P, and `newest` [N, W] are the rows of the
    newest chunk.
    """

    rows: Float64
    weights: Float64
    newest: Float64


class Mixture:
    """Mixer of chunks' rows in the way in which control mixes plans.

    Control mixes joints, so rows of poses are computed from mixed joints. Binary grippers are not mixed but taken from
    the newest row, as received. `dims` are the dimensions that cannot be mixed linearly: binary grippers, and angles
    without limits.
    """

    def __init__(self, dims: DimensionKinds | None = None, robot: Robot | None = None) -> None:
        self._dims = DimensionKinds() if dims is None else dims
        self._robot = robot
        self._layout: PoseRows | None = None  # a policy uses a single format

    def joints(self, parts: MixtureParts) -> Float64:
        """Mix joint rows [N, D]. Angles without limits are within half a turn of the newest row."""
        return _mixed(parts, self._dims.switched, self._dims.wrapping)

    def numbers(self, parts: MixtureParts, like: ActionChunk) -> Float64:
        """Mix the rows in `parts` linearly, and return the mixed rows [N, W].

        The rows may be of any kind that can be mixed linearly, for example rows in model space. `like` is a chunk with
        the same columns; it tells which columns are binary grippers.
        """
        return _mixed(parts, self._switched(like), ())

    def poses(self, joints: Float64, newest: Float64, like: ActionChunk) -> Float64:
        """Return the poses [N, W] of joints [N, D] in the format of `like`.

        Where a format is ambiguous, the numbers are as close to those of `newest` as possible.
        """
        layout = self._layout_of(like)
        encoded = layout.encode(self._end_effectors.vectors(joints), joints, newest)
        switched = self._switched(like)
        encoded[:, switched] = newest[:, switched]
        return encoded

    def relative(
        self, joints: Float64, newest: Float64, like: ActionChunk, observation: Observation
    ) -> Float64:
        """Return joints [N, D] of successive rows as rows [N, W] in the format of `like`, relative to `observation`.

        This inverts the conversion of a chunk of relative rows to joints. Binary grippers are those of `newest`.
        """
        robot, qpos = self._loaded_robot, np.asarray(observation.qpos, np.float64)
        before = qpos if like.mode == "relative" else np.concatenate([qpos[None], joints[:-1]])
        moved = difference(joints, before, self._dims.wrapping)
        still = [*robot.gripper_dims, *robot.speed_dims]  # absolute in every mode
        moved[:, still] = joints[:, still]
        if like.space == "joint":
            encoded = moved
        else:
            layout, at = self._layout_of(like), qpos[None]
            eef = self._end_effectors.eef_of(qpos) if observation.eef is None else observation.eef
            vectors = np.asarray(eef, np.float64).reshape(1, -1, EEF_WIDTH)
            start = layout.frame.express(layout.normalize_quaternions(vectors), at)[0]
            poses = layout.frame.express(self._end_effectors.vectors(joints), at)
            poses = relative(poses, start, like.mode, like.frame)
            encoded = layout.written(poses, moved[:, layout.dims], newest)
        switched = self._switched(like)
        encoded[:, switched] = newest[:, switched]
        return encoded

    def mixes_linearly(self, straight: Float64, meant: Float64, like: ActionChunk) -> bool:
        """Return True if the linear mixture `straight` equals `meant` within tolerance.

        `meant` is the mixture that control makes. The two differ, for example, if angles wrap. `like` is a chunk whose
        columns are those of both mixtures.
        """
        if like.space == "joint":
            return bool(np.abs(straight - meant).max(initial=0.0) <= _ROUND)
        try:
            straight_quaternions, meant_quaternions = (
                self._layout_of(like).decode(rows)[0][..., 3:7] for rows in (straight, meant)
            )
        except PolicyError:  # they determine no orientation
            return False
        cosines = np.abs((straight_quaternions * meant_quaternions).sum(axis=-1))
        return bool(2.0 * np.arccos(np.clip(cosines, 0.0, 1.0)).max(initial=0.0) <= _ROUND)

    def _switched(self, like: ActionChunk) -> list[int]:
        """Return the columns of binary grippers in the rows of `like`."""
        if like.space == "joint":
            return list(self._dims.switched)
        binary = self._loaded_robot.binary_dims
        return [place for place, dim in self._layout_of(like).commanded if dim in binary]

    def _layout_of(self, like: ActionChunk) -> PoseRows:
        pose = CANONICAL if like.pose is None else like.pose
        if self._layout is None or self._layout.pose != pose:
            self._layout = PoseRows(pose, self._loaded_robot)
        return self._layout

    @cached_property
    def _end_effectors(self) -> EndEffectors:
        return EndEffectors(self._loaded_robot, ChainForward(self._loaded_robot))

    @property
    def _loaded_robot(self) -> Robot:
        assert self._robot is not None, "rows of poses need the robot whose they are"
        return self._robot


def _mixed(parts: MixtureParts, switched: Sequence[int], wrapping: Sequence[int]) -> Float64:
    """Mix rows as the newest row plus weighted differences, so that equal rows stay equal to the last bit.

    The columns `switched` are copied from the newest row. In the columns `wrapping` (angles), differences are taken the
    shorter way around.
    """
    apart = difference(parts.rows, parts.newest, wrapping)
    mixed: Float64 = parts.newest + (parts.weights[..., None] * apart).sum(axis=0)
    mixed[:, list(switched)] = parts.newest[:, list(switched)]
    return mixed
