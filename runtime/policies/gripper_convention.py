"""Conversion of grippers between DROID's convention, 0 open and 1 closed, and a robot's own values."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from runtime.core.types import EEF_WIDTH, Float32, Float64, Observation
from runtime.spaces.pose_rows import PoseRows

if TYPE_CHECKING:
    from robots import Robot

Convention = Literal["droid", "robot"]


class GripperConvention:
    """Conversion of a robot's gripper values; with the convention "robot" they are unchanged.

    `poses` is the row format of the responses if they contain poses, None for joints.
    """

    def __init__(self, convention: Convention, robot: Robot, poses: PoseRows | None = None) -> None:
        grippers = [group.gripper for group in robot.groups if group.gripper is not None]
        self._converts = convention == "droid"
        self._open = np.array([gripper.open for gripper in grippers], np.float64)
        self._travel = np.array([gripper.close - gripper.open for gripper in grippers], np.float64)
        self._dims = list(robot.gripper_dims)
        self._columns = _columns(robot, poses)
        arms = [(arm, group.gripper_dim) for arm, group in enumerate(robot.arms)]
        self._gripped = [(EEF_WIDTH * arm + EEF_WIDTH - 1, dim) for arm, dim in arms if dim is not None]

    def to_policy(self, numbers: Float64) -> Float64:
        """Convert gripper values [..., G] to the policy's, clipped to 0 and 1."""
        if not self._converts:
            return numbers
        return np.clip((numbers - self._open) / self._travel, 0.0, 1.0)

    def convert_observation(self, observation: Observation) -> Observation:
        """Return the observation with the policy's values for the grippers in its joints and poses."""
        if not self._converts:
            return observation
        qpos = observation.qpos.copy()
        qpos[self._dims] = self.to_policy(qpos[self._dims].astype(np.float64))
        eef = observation.eef
        if eef is not None:
            eef = eef.copy()
            for place, dim in self._gripped:
                eef[place] = qpos[dim]
        return replace(observation, qpos=qpos, eef=eef)

    def to_robot(self, rows: Float32) -> Float32:
        """Convert the grippers in the rows of a response [T, W] to the robot's values, within the grippers' travel."""
        if not self._converts:
            return rows
        converted = rows.copy()
        for column, gripper in self._columns:
            share = np.clip(rows[:, column], 0.0, 1.0)
            converted[:, column] = self._open[gripper] + share * self._travel[gripper]
        return converted

    def served(self, rows: Float32) -> Float32:
        """Convert the grippers in rows [T, W] from the robot's values back to the server's."""
        if not self._converts:
            return rows
        converted = rows.copy()
        for column, gripper in self._columns:
            converted[:, column] = (rows[:, column] - self._open[gripper]) / self._travel[gripper]
        return converted


def _columns(robot: Robot, poses: PoseRows | None) -> list[tuple[int, int]]:
    """Return for each gripper column of a row its index and the index of the robot's gripper."""
    dims = list(robot.gripper_dims)
    if poses is None:
        return [(dim, gripper) for gripper, dim in enumerate(dims)]
    appended = poses.width - len(poses.dims)
    arm_width = appended // len(robot.arms)
    columns = [(appended + n, dims.index(dim)) for n, dim in enumerate(poses.dims.tolist()) if dim in dims]
    if poses.pose.gripper:
        for arm, group in enumerate(robot.arms):
            if group.gripper_dim is not None:
                columns.append((arm_width * arm + arm_width - 1, dims.index(group.gripper_dim)))
    return columns
