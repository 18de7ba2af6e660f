"""End-effector vectors for given joints, by forward kinematics."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from robots import Robot
from runtime.core.types import EEF_WIDTH, Float32, Float64
from runtime.kinematics.base import Forward
from runtime.spaces.orientations import continuous_signs

_GRIPPER = EEF_WIDTH - 1


class EndEffectors:
    """Calculator of the end-effector vectors of a robot's arms: x, y, z [m], unit quaternion w, x, y, z, gripper.

    Poses are in each arm's declared frame.
    """

    def __init__(self, robot: Robot, forward: Forward) -> None:
        arms = robot.arms
        self._forward = forward
        self._count = len(arms)
        self._gripped = [index for index, arm in enumerate(arms) if arm.gripper is not None]
        self._grippers = [arm.gripper_dim for arm in arms if arm.gripper_dim is not None]

    def eef_of(self, q: ArrayLike, previous: ArrayLike | None = None) -> Float32:
        """Return end-effector vectors float32 [..., 8 * arms] for joints [..., D].

        Quaternions of rows [T, D] have continuous signs. The (first) quaternion has w >= 0 or, if `previous` [8 * arms]
        is given, the sign closer to it, so that a sequence of single calls is continuous, too.
        """
        joints = np.asarray(q, dtype=np.float64)
        vectors = self.vectors(joints)
        if previous is not None:
            before = np.asarray(previous, dtype=np.float64).reshape(self._count, EEF_WIDTH)
            first = vectors if joints.ndim == 1 else vectors[0]
            turned = np.sum(first[:, 3:7] * before[:, 3:7], axis=-1) < 0
            first[turned, 3:7] *= -1.0
        if joints.ndim > 1:
            vectors[..., 3:7] *= continuous_signs(vectors[..., 3:7])
        return vectors.reshape(*joints.shape[:-1], -1).astype(np.float32)

    def vectors(self, joints: Float64) -> Float64:
        """Return the vectors as float64 [..., arms, 8], with w >= 0; an arm without a gripper has 0 as gripper
        value.
        """
        vectors = np.zeros((*joints.shape[:-1], self._count, EEF_WIDTH))
        vectors[..., :_GRIPPER] = self._forward.forward(joints)
        vectors[..., self._gripped, _GRIPPER] = joints[..., self._grippers]
        return vectors
