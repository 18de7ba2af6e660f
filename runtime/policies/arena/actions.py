"""Rows of RoboArena responses: joints or poses, targets or velocities, grippers in DROID's convention."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from runtime.core.errors import ActionSpaceError, ConfigurationError, ShapeError
from runtime.core.pose_format import PoseFormat
from runtime.core.settings import Settings
from runtime.core.types import ActionChunk, Float32
from runtime.policies.action_layout import Rate
from runtime.policies.action_rows import parse_action_rows
from runtime.policies.arena.requirements import ActionSpace, ServerRequirements
from runtime.policies.gripper_convention import Convention, GripperConvention
from runtime.spaces.pose_rows import PoseRows

if TYPE_CHECKING:
    from robots import Robot

Step = Annotated[float, Field(gt=0, le=1.0)]


class VelocitySteps(Settings):
    """Motion per row of a response at a velocity of 1.0; the defaults are DROID's, at 15 rows per second."""

    joint: Step = 0.2
    """Motion of each joint [rad]."""
    linear: Step = 0.075
    """Translation of the end effector [m]."""
    angular: Step = 0.15
    """Rotation of the end effector [rad]."""


class ArenaActionSettings(Settings):
    """Format of the responses of a server of the RoboArena family."""

    action_space: ActionSpace = "joint_position"
    """Content of the rows; a server that declares another action space is refused."""
    action_pose: PoseFormat = PoseFormat(orientation="euler")
    """Format of the poses in a response, with a cartesian action_space."""
    velocity_steps: VelocitySteps | None = None
    """Motion per row at a velocity of 1.0; required with joint_velocity and cartesian_velocity."""
    action_rate: Rate | None = None
    """Rows per second of a response [Hz], 15 for DROID; absent: the control rate."""
    action_keys: Annotated[list[str], Field(min_length=1)] | None = None
    """Names of the parts of a response that comes in parts, in the order of the row; absent: the server's own."""


class ArenaActions:
    """Reader of responses; it returns chunks in the robot's values.

    Raises ConfigurationError if a setting does not fit the robot.
    """

    def __init__(self, settings: ArenaActionSettings, convention: Convention, robot: Robot) -> None:
        self._settings = settings
        self.cartesian = settings.action_space.startswith("cartesian")
        self.velocity = settings.action_space.endswith("velocity")
        self._steps = _steps(settings) if self.velocity else VelocitySteps()
        self._still = [dim for dim in range(robot.dim) if dim not in robot.gripper_dims]
        self._poses = PoseRows(settings.action_pose, robot, "policy.action_pose") if self.cartesian else None
        self._grip = GripperConvention(convention, robot, self._poses)
        self.width = robot.dim if self._poses is None else self._poses.width
        self._arms = len(robot.arms)
        self._each = 0 if self._poses is None else (self.width - len(self._poses.dims)) // self._arms
        self._parts: tuple[str, ...] = tuple(settings.action_keys or ())

    def configure(self, wants: ServerRequirements) -> None:
        """Check that the server's requirements agree with the deployment's action space and width.

        Raises ActionSpaceError, whose message has both values, if they differ.
        """
        settings = self._settings
        if wants.space != settings.action_space:
            raise ActionSpaceError(
                f"the server's metadata has action_space = {wants.space!r}, policy.action_space = "
                f"{settings.action_space!r}; correct the one that is wrong"
            )
        if wants.width is not None and wants.width != self.width:
            raise ActionSpaceError(
                f"the server's metadata has action_dim = {wants.width}, this robot has {self.width} numbers in "
                f"{settings.action_space}; correct policy.action_space, or another robot's policy is served"
            )
        self._parts = tuple(settings.action_keys or wants.parts)

    def chunk(self, reply: Any, timing: Mapping[str, float]) -> ActionChunk:
        """Return the chunk of a response, which is an array, a map with `actions`, or a map of named parts."""
        rows = parse_action_rows("actions", self._array(reply), self.width)
        if self.velocity:
            rows = self._steps_of_joints(rows) if self._poses is None else self._steps_of_poses(rows)
        rows = self._grip.to_robot(rows)
        return ActionChunk(
            actions=rows,
            space="eef" if self.cartesian else "joint",
            rate=self._settings.action_rate,
            mode="delta" if self.velocity else "absolute",
            pose=self._settings.action_pose if self.cartesian else None,
            timing=timing,
        )

    def _array(self, reply: Any) -> object:
        if isinstance(reply, Mapping) and "actions" in reply:
            reply = reply["actions"]
        if not isinstance(reply, Mapping):
            return reply
        missing = [name for name in self._parts if name not in reply]
        if missing or not self._parts:
            keys = ", ".join(map(str, reply)) or "nothing"
            raise ShapeError(
                f"the answer has no 'actions' but {keys}; allowed: an array, a map with 'actions', or parts named "
                f"in policy.action_keys ({', '.join(self._parts) or 'none'})"
            )
        parts = [parse_action_rows(name, reply[name]) for name in self._parts]
        if len({len(part) for part in parts}) != 1:
            lengths = ", ".join(f"{name} {len(part)}" for name, part in zip(self._parts, parts, strict=True))
            raise ShapeError(f"the parts of the answer have different numbers of rows: {lengths}")
        return np.concatenate(parts, axis=1)

    def _steps_of_joints(self, rows: Float32) -> Float32:
        rows[:, self._still] = np.clip(rows[:, self._still], -1.0, 1.0) * np.float32(self._steps.joint)
        return rows

    def _steps_of_poses(self, rows: Float32) -> Float32:
        posed = self._each * self._arms
        arms = rows[:, :posed].reshape(len(rows), self._arms, self._each)
        arms[..., :3] = _clip_norm(arms[..., :3]) * np.float32(self._steps.linear)
        arms[..., 3:6] = _clip_norm(arms[..., 3:6]) * np.float32(self._steps.angular)
        return np.concatenate([arms.reshape(len(rows), -1), rows[:, posed:]], axis=1)


def _clip_norm(vectors: Float32) -> Float32:
    """Shorten vectors that are longer than 1, preserving their direction."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    bounded: Float32 = vectors / np.maximum(lengths, np.float32(1.0))
    return bounded


def _steps(settings: ArenaActionSettings) -> VelocitySteps:
    if settings.velocity_steps is None:
        raise ConfigurationError(
            f"policy.action_space = {settings.action_space!r} without policy.velocity_steps: velocities are shares "
            "of a step that the server does not tell; allowed: a table with what 1.0 moves per row (DROID: joint = "
            "0.2, linear = 0.075, angular = 0.15, action_rate = 15.0), or a position space"
        )
    pose = settings.action_pose
    if settings.action_space == "cartesian_velocity" and (
        pose.orientation not in ("euler", "rotation_vector") or pose.degrees
    ):
        raise ConfigurationError(
            f"policy.action_pose is {pose} with cartesian_velocity; allowed: three turning speeds, orientation = "
            '"euler" or "rotation_vector", in radians'
        )
    return settings.velocity_steps
