"""From the space a policy speaks to the one the robot is commanded in; end-effector vectors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robots import Robot
from runtime.errors import PolicyError, SetupError
from runtime.kinematics.base import IkResult, Kinematics
from runtime.poses import absolute, canonical, continuous_signs
from runtime.resampling import resample
from runtime.types import EEF_WIDTH, ActionChunk, Float32, Float64, Observation

_GRIPPER = EEF_WIDTH - 1
_LONGEST = 2000  # rows of a chunk, given and at control rate: they are solved one by one, and fit the ring to control


@dataclass(frozen=True, slots=True)
class CommandRows:
    """A chunk in command space at control rate.

    `rows` float64 [H', D] are absolute joint targets; `source` int64 [H'] is the policy's row that each was made
    from; `solved` says how well poses were met, None for a joint chunk.
    """

    rows: Float64
    source: NDArray[np.int64]
    solved: IkResult | None


class Spaces:
    """One robot's action spaces: joint rows [H, D], and eef rows [H, 8 * arms] that become joints by kinematics.

    An arm's vector is x, y, z [m], unit quaternion w, x, y, z, gripper, in the arm's declared frame.
    `control_rate` [Hz] is the rate of commands, and of chunks that name none.
    """

    def __init__(self, robot: Robot, kinematics: Kinematics, control_rate: float) -> None:
        if not control_rate > 0:
            raise SetupError(f"control_rate = {control_rate} Hz; allowed: above zero")
        self._robot = robot
        self._kinematics = kinematics
        self._control_rate = control_rate
        self._grippers = np.array([arm.gripper_dim for arm in robot.arms], dtype=np.intp)
        self._moving = np.setdiff1d(np.arange(robot.dim), robot.gripper_dims)
        endless = np.isinf(robot.lower) & np.isinf(robot.upper)
        self._wrapping = np.flatnonzero(endless)
        arms = range(len(robot.arms))
        self._quaternions = [EEF_WIDTH * arm + 3 for arm in arms]
        self._held = [EEF_WIDTH * a + _GRIPPER for a in arms if self._grippers[a] in robot.binary_dims]

    def to_command(self, chunk: ActionChunk, observation: Observation) -> CommandRows:
        """The chunk, which answers `observation`, as absolute joint rows at control rate.

        In this order: checked; made absolute against the observation (poses against the measured ones, else
        those of its joints); resampled in the policy's own space; poses solved, the first row from the
        observed joints, each further one from the row before within velocity limits; joints without limits
        unwrapped from the observed ones on. Grippers are taken as they are; joints that no arm moves (a head)
        stay where an eef chunk found them. Raises PolicyError for a wrong width, a number that is not finite,
        or a quaternion without direction.
        """
        rows = self._checked(chunk)
        rate = chunk.rate or self._control_rate
        _check_length(len(rows), max(1.0, self._control_rate / rate))
        qpos = np.asarray(observation.qpos, dtype=np.float64)
        if chunk.space == "joint":
            rows = self._unwrapped(self._absolute_joints(rows, chunk, qpos), qpos)
            rows, source = resample(rows, rate, self._control_rate, self._robot.binary_dims)
            return CommandRows(rows, source, None)
        vectors = self._absolute_poses(rows, chunk, observation).reshape(len(rows), -1)
        vectors, source = resample(vectors, rate, self._control_rate, self._held, self._quaternions)
        solved = self._solved(vectors, qpos)
        return CommandRows(self._unwrapped(self._with_grippers(solved, vectors), qpos), source, solved)

    def eef_of(self, q: ArrayLike, previous: ArrayLike | None = None) -> Float32:
        """End-effector vectors float32 [..., 8 * arms] that joints [..., D] and their grippers amount to.

        Rows [T, D] come out sign-continuous. The (first) quaternion has w >= 0, or the sign nearer to
        `previous` [8 * arms] where that is given, so that a stream of single calls is continuous too.
        """
        joints = np.asarray(q, dtype=np.float64)
        vectors = np.empty((*joints.shape[:-1], len(self._grippers), EEF_WIDTH))
        vectors[..., :_GRIPPER] = self._kinematics.forward(joints)
        vectors[..., _GRIPPER] = joints[..., self._grippers]
        if previous is not None:
            before = np.asarray(previous, dtype=np.float64).reshape(len(self._grippers), EEF_WIDTH)
            first = vectors if joints.ndim == 1 else vectors[0]
            turned = np.sum(first[:, 3:7] * before[:, 3:7], axis=-1) < 0
            first[turned, 3:7] *= -1.0
        if joints.ndim > 1:
            vectors[..., 3:7] *= continuous_signs(vectors[..., 3:7])
        return vectors.reshape(*joints.shape[:-1], -1).astype(np.float32)

    def _absolute_joints(self, rows: Float64, chunk: ActionChunk, qpos: Float64) -> Float64:
        if chunk.mode == "absolute":
            return rows
        moves = rows[:, self._moving]
        rows[:, self._moving] = qpos[self._moving] + (
            moves if chunk.mode == "relative" else moves.cumsum(axis=0)
        )
        return rows

    def _absolute_poses(self, rows: Float64, chunk: ActionChunk, observation: Observation) -> Float64:
        vectors = canonical(rows.reshape(len(rows), len(self._grippers), EEF_WIDTH))
        if chunk.mode == "absolute":
            return vectors
        seen = self.eef_of(observation.qpos) if observation.eef is None else observation.eef
        poses = np.asarray(seen, dtype=np.float64).reshape(1, len(self._grippers), EEF_WIDTH)
        start = canonical(poses, f"the chunk is {chunk.mode} to an observation with")[0]
        return absolute(vectors, start, chunk.mode, chunk.frame)

    def _solved(self, vectors: Float64, qpos: Float64) -> IkResult:
        poses = vectors.reshape(len(vectors), len(self._grippers), EEF_WIDTH)[..., :_GRIPPER]
        return self._kinematics.solve(poses, qpos, 1.0 / self._control_rate)

    def _with_grippers(self, solved: IkResult, vectors: Float64) -> Float64:
        commands = solved.q.copy()
        commands[:, self._grippers] = vectors[:, _GRIPPER::EEF_WIDTH]
        return commands

    def _unwrapped(self, rows: Float64, qpos: Float64) -> Float64:
        """The rows with endless joints on the branch that is nearest to `qpos`, and without jumps from there."""
        turning = np.concatenate([qpos[None], rows])[:, self._wrapping]
        rows[:, self._wrapping] = np.unwrap(turning, axis=0)[1:]
        return rows

    def _checked(self, chunk: ActionChunk) -> Float64:
        width = self._robot.dim if chunk.space == "joint" else self._robot.eef_dim
        rows = np.array(chunk.actions, dtype=np.float64)
        if rows.ndim != 2 or rows.shape[1] != width or not len(rows):
            raise PolicyError(
                f"the policy answered with {chunk.space} actions of shape {rows.shape}; "
                f"{self._robot.name} takes [H, {width}] with at least one row"
            )
        wrong = np.argwhere(~np.isfinite(rows))
        if len(wrong):
            row, column = wrong[0]
            names = self._robot.joint_names if chunk.space == "joint" else self._robot.eef_names
            raise PolicyError(
                f"the policy answered with {rows[row, column]} for {names[column]} in row {row} "
                f"({len(wrong)} such numbers); allowed: finite numbers"
            )
        return rows


def _check_length(count: int, stretched: float) -> None:
    if count * stretched > _LONGEST:
        at_rate = "" if stretched == 1.0 else f", {count * stretched:.0f} at control rate"
        raise PolicyError(
            f"the policy answered with {count} rows{at_rate}; allowed: at most {_LONGEST} in one chunk"
        )
