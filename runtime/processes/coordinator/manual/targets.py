"""Targets of the operator: named poses, joints, end effector jogs, checked before anything moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robots.rotations import matrix_of_quaternion, matrix_of_rpy, quaternion_of_matrix
from runtime.core.errors import RuntimeFault
from runtime.core.sentences import Pattern
from runtime.core.types import Float32, Float64
from runtime.ipc.command_arguments import AimRequest, Jog, MoveRequest
from runtime.kinematics.base import Kinematics
from runtime.motion.trajectories import Trajectory
from runtime.processes.coordinator.path_check import PathCheck
from runtime.spaces.conversion import ActionSpaces
from runtime.station.spec import StationSpec

_NO_TARGET = Pattern("targets.no_target", "move: say joints or a pose; poses of {robot}: {poses}")
_SPEED_AT_END = Pattern(
    "targets.speed_at_end",
    "move: {name} = {value:.4f} is a speed; allowed at the end of a motion: 0",
)
_BEYOND_LIMITS = Pattern(
    "targets.beyond_limits",
    "{what}: {name} = {value:.4f}; allowed: {lower:g} to {upper:g}",
)
_JOINTS_AND_POSE = Pattern(
    "targets.joints_and_pose",
    "{what}: joints and the pose {pose!r}; allowed: one of the two",
)
_NO_SUCH_POSE = Pattern("targets.no_such_pose", "{what}: pose = {pose!r}; {robot} has {poses}")
_NUMBER_OF_JOINTS = Pattern("targets.number_of_joints", "{what}: {given} joints; {robot} has {expected}")
_NO_SUCH_ARM = Pattern("targets.no_such_arm", "aim: jog.arm = {arm!r}; {robot} has {arms}")

_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True)
class TargetPreview:
    """Target float64 [D] within limits, its poses float32 [8 * arms], and its deviations from the request.

    `clipped` names joints that were clipped to a limit. If the request was a jog, `position_error` and `rotation_error`
    are the errors of the pose that was reached; otherwise both are 0.
    """

    joints: Float64
    poses: Float32
    clipped: tuple[str, ...]
    reached: bool = True
    position_error: float = 0.0  # [m]
    rotation_error: float = 0.0  # [rad]


class Targets:
    """Conversion of an operator's requests to joint targets of one robot."""

    def __init__(self, spec: StationSpec, spaces: ActionSpaces, kinematics: Kinematics) -> None:
        self._plan = spec
        self._spaces = spaces
        self._kinematics = kinematics
        self._ways = PathCheck(spec)

    def prepare(self) -> bool:
        """Start to load the kinematics that a jog needs; return True if they are loaded."""
        return self._kinematics.prepare()

    def aim(self, asked: AimRequest, commanded: Float64) -> TargetPreview:
        """Return a preview of a target.

        Raises:
            RuntimeFault: the robot has no such pose, arm or number of joints.
        """
        start = self._requested_joints("aim", asked.joints, asked.pose, commanded)
        if asked.jog is None:
            return self._clipped(start)
        return self._jogged(asked.jog, start)

    def motion_goal(self, asked: MoveRequest, commanded: Float64) -> Float64:
        """Return the end of a motion from `commanded`, with its whole path checked.

        Raises:
            RuntimeFault: the request or the path is not allowed.
        """
        if asked.joints is None and asked.pose is None:
            raise RuntimeFault(_NO_TARGET(robot=self._plan.robot.name, poses=self._poses()))
        goal = self._requested_joints("move", asked.joints, asked.pose, commanded)
        for dim in self._plan.limits.speeds:
            if goal[dim]:
                name = self._plan.limits.names[dim]
                raise RuntimeFault(_SPEED_AT_END(name=name, value=goal[dim]))
        return self.check_motion("move", goal, commanded)

    def check_motion(self, what: str, goal: Float64, commanded: Float64) -> Float64:
        """Return `goal` [D] if limits, workspace boxes and collisions permit the path from `commanded` [D] to it.

        Dimensions of the goal that are speeds are set to 0, because generated motions end at rest. `what` begins the
        message of an error.

        Raises:
            RuntimeFault: the goal or the path is not allowed.
        """
        limits = self._plan.limits
        goal = limits.with_zero_speeds(goal)
        beyond = np.flatnonzero((goal < limits.lower - _TOLERANCE) | (goal > limits.upper + _TOLERANCE))
        if len(beyond):
            worst = int(beyond[0])
            raise RuntimeFault(
                _BEYOND_LIMITS(
                    what=what,
                    name=limits.names[worst],
                    value=goal[worst],
                    lower=limits.lower[worst],
                    upper=limits.upper[worst],
                )
            )
        self._ways.check(what, commanded, goal)
        return goal

    def duration(self, start: Float64, goal: Float64, speed: float = 1.0) -> float:
        """Return the duration of a generated motion [s]."""
        safety, limits = self._plan.deployment.safety, self._plan.limits
        velocity = limits.velocity * safety.motion_velocity_scale * speed
        return Trajectory(start, goal, velocity, safety.motion_acceleration * limits.radian_scale).duration

    def _requested_joints(
        self, label: str, joints: Sequence[float | None] | None, pose: str | None, commanded: Float64
    ) -> Float64:
        robot = self._plan.robot
        if joints is not None and pose is not None:
            raise RuntimeFault(_JOINTS_AND_POSE(what=label, pose=pose))
        if pose is not None:
            if pose not in robot.poses:
                raise RuntimeFault(
                    _NO_SUCH_POSE(what=label, pose=pose, robot=robot.name, poses=self._poses())
                )
            return np.array(robot.poses[pose], np.float64)
        if joints is None:
            return commanded.copy()
        if len(joints) != robot.dim:
            raise RuntimeFault(
                _NUMBER_OF_JOINTS(what=label, given=len(joints), robot=robot.name, expected=robot.dim)
            )
        return np.array(
            [now if value is None else value for value, now in zip(joints, commanded, strict=True)]
        )

    def _poses(self) -> str:
        return ", ".join(sorted(self._plan.robot.poses))

    def _clipped(self, joints: Float64) -> TargetPreview:
        limits = self._plan.limits
        allowed = np.clip(joints, limits.lower, limits.upper)
        moved = np.flatnonzero(np.abs(allowed - joints) > _TOLERANCE)
        return TargetPreview(allowed, self._spaces.eef_of(allowed), tuple(limits.names[i] for i in moved))

    def _jogged(self, jog: Jog, start: Float64) -> TargetPreview:
        arms = [arm.name for arm in self._plan.robot.arms]
        if jog.arm not in arms:
            raise RuntimeFault(_NO_SUCH_ARM(arm=jog.arm, robot=self._plan.robot.name, arms=", ".join(arms)))
        index = arms.index(jog.arm)
        poses = self._kinematics.forward(start)
        poses[index] = _apply_jog(poses[index], jog)
        solved = self._kinematics.solve(poses[None], start)
        aimed = self._clipped(solved.q[0])
        return TargetPreview(
            aimed.joints,
            aimed.poses,
            aimed.clipped,
            bool(solved.reached[0].all()),
            float(solved.position_error[0, index]),
            float(solved.rotation_error[0, index]),
        )


def _apply_jog(pose: Float64, jog: Jog) -> Float64:
    """Return the pose [7] (x, y, z, qw, qx, qy, qz) after the jog."""
    turn, shift = matrix_of_rpy(*jog.rotation), np.array(jog.translation, np.float64)
    rotation = matrix_of_quaternion(pose[3:])
    turned = rotation @ turn if jog.frame == "tool" else turn @ rotation
    moved = rotation @ shift if jog.frame == "tool" else shift
    return np.concatenate([pose[:3] + moved, quaternion_of_matrix(turned)])


def aim_to_dict(aim: TargetPreview, spec: StationSpec, distance: float, duration: float) -> dict[str, Any]:
    """Return the preview `aim` as an answer for a client: joints, poses, errors in mm and degrees."""
    return {
        "joints": aim.joints.tolist(),
        "poses": aim.poses.tolist(),
        "reached": aim.reached,
        "position_error_mm": aim.position_error * 1000,
        "rotation_error_deg": float(np.degrees(aim.rotation_error)),
        "clipped": list(aim.clipped),
        "distance": distance,
        "duration_s": duration,
        "robot": spec.robot.name,
    }
