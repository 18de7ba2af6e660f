"""From the space a policy speaks to the one the robot is commanded in; end-effector vectors."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from robots import Robot
from runtime.errors import PolicyError, SetupError
from runtime.kinematics.base import IkResult, Kinematics
from runtime.types import EEF_WIDTH, ActionChunk, Float32, Float64

_GRIPPER = EEF_WIDTH - 1
_SHORTEST_QUATERNION = (
    1e-3  # a unit quaternion that a network predicts is off by per cents, never by this much
)


class Spaces:
    """One robot's action spaces: joint rows [H, D] pass, eef rows [H, 8 * arms] become joints by kinematics.

    An arm's vector is x, y, z [m], unit quaternion w, x, y, z, gripper, in the arm's declared frame.
    `control_rate` [Hz] is the rate of chunks that name none.
    """

    def __init__(self, robot: Robot, kinematics: Kinematics, control_rate: float) -> None:
        if not control_rate > 0:
            raise SetupError(f"control_rate = {control_rate} Hz; allowed: above zero")
        self._robot = robot
        self._kinematics = kinematics
        self._control_rate = control_rate
        self._grippers = np.array([arm.gripper_dim for arm in robot.arms], dtype=np.intp)

    def to_command(self, chunk: ActionChunk, qpos: Float32) -> tuple[Float64, IkResult | None]:
        """The chunk as joint rows float64 [H, D], and how well its poses were met (None for joint chunks).

        `qpos` [D] are the joints the chunk was asked for: the first row is solved from there, each further
        row from the one before within velocity limits. Grippers are taken from the chunk as they are; joints
        that no arm moves (a head) keep `qpos`. Raises PolicyError for a wrong width, a number that is not
        finite, or a quaternion without direction.
        """
        rows = self._checked(chunk)
        if chunk.space == "joint":
            return rows, None
        vectors = canonical(rows.reshape(len(rows), len(self._grippers), EEF_WIDTH))
        period = 1.0 / (chunk.rate or self._control_rate)
        result = self._kinematics.solve(vectors[..., :_GRIPPER], np.asarray(qpos, dtype=np.float64), period)
        commands = result.q.copy()
        commands[:, self._grippers] = vectors[..., _GRIPPER]
        return commands, result

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
            vectors[..., 3:7] *= _signs(vectors[..., 3:7])
        return vectors.reshape(*joints.shape[:-1], -1).astype(np.float32)

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


def canonical(vectors: Float64) -> Float64:
    """End-effector vectors [T, arms, 8] with unit quaternions, first w >= 0, signs continuous along T.

    Raises PolicyError for a quaternion that is too short to have a direction.
    """
    quaternions = vectors[..., 3:7]
    norms = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    if (norms < _SHORTEST_QUATERNION).any():
        row, arm = np.argwhere(norms[..., 0] < _SHORTEST_QUATERNION)[0]
        raise PolicyError(
            f"the policy answered with quaternion {quaternions[row, arm].tolist()}, arm {arm}, row {row}; "
            f"allowed: w, x, y, z of length 1 (it is normalised from {_SHORTEST_QUATERNION:g} on)"
        )
    result = vectors.copy()
    result[..., 3:7] = quaternions / norms
    result[0, :, 3:7] *= np.where(result[0, :, 3:4] < 0, -1.0, 1.0)
    result[..., 3:7] *= _signs(result[..., 3:7])
    return result


def _signs(quaternions: Float64) -> Float64:
    """The factors +-1 [T, arms, 1] that turn each quaternion [T, arms, 4] to its predecessor's side."""
    dots = np.sum(quaternions[1:] * quaternions[:-1], axis=-1, keepdims=True)
    flips = np.where(dots < 0, -1.0, 1.0)
    signs = np.ones((*quaternions.shape[:-1], 1))
    signs[1:] = np.cumprod(flips, axis=0)
    return signs
