"""Safety settings of a deployment."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from robots.clearance import MARGIN
from runtime.core.settings import Settings

_NOISE = 0.02  # [rad] margin on a configured `steady_error`
_BESIDE = 0.1  # [rad] least permitted offset of an arm


class WorkspaceBox(Settings):
    """A box in an arm's declared frame that its end effector must stay in [m]."""

    lower: list[float] = Field(min_length=3, max_length=3)
    """Corner with the smallest x, y and z."""
    upper: list[float] = Field(min_length=3, max_length=3)
    """Corner with the largest x, y and z."""


class SafetySettings(Settings):
    """Limits on every action; the defaults come from what a real demonstration reaches."""

    report_only: bool = False
    """Judge and report, but send actions as they are; refused for a transport that can move a robot."""
    joint_age_s: float = Field(default=0.2, gt=0)
    """Oldest joint measurement that a policy action may be based on [s]."""
    joint_gap_s: float = Field(default=1.0, ge=0)
    """Oldest joint measurement at which a run that stands for that alone still goes on by itself once they are back,
    where they were [s]."""
    picture_age_s: float = Field(default=0.5, gt=0)
    """Oldest picture of any camera that a policy action may be based on [s]."""
    following_error: float = Field(default=0.5, gt=0)
    """Farthest that a target may be from the measured joints [rad]."""
    steady_error: float = Field(default=0.1, ge=0)
    """Farthest that gravity and payload hold a joint from its command [rad]: an e-stop keeps the command there."""
    jump: float = Field(default=0.5, gt=0)
    """Farthest that an action may be from the last command [rad]."""
    missed_pose: Literal["refuse", "flag"] = "refuse"
    """What becomes of a pose of the policy that no joints meet within the two below, or that is a `jump` ahead of where
    joints can be by then: "refuse" executes the rows before it, and holds where there are none; "flag" goes as near as
    joints can, as fast as they may, and says so."""
    missed_pose_m: float = Field(default=0.02, gt=0)
    """Farthest that the nearest joints may miss the position of a pose [m]."""
    missed_pose_rad: float = Field(default=0.2, gt=0)
    """Farthest that they may miss its orientation [rad]."""
    velocity_scale: float = Field(default=1.0, gt=0, le=1)
    """Part of the robot's joint velocities that may be used."""
    acceleration: float = Field(default=60.0, gt=0)
    """Joint acceleration on the policy path [rad/s2]."""
    motion_acceleration: float = Field(default=5.0, gt=0)
    """Joint acceleration of motions of ours, such as homing [rad/s2]."""
    motion_velocity_scale: float = Field(default=0.3, gt=0, le=1)
    """Part of the joint velocities that motions of ours use."""
    brake_acceleration: float = Field(default=20.0, gt=0)
    """Deceleration of a stop or a halt [rad/s2]."""
    refusals_to_hold: int = Field(default=10, ge=1)
    """Refused actions in a row that lead to holding."""
    first_action_far: float = Field(default=0.3, gt=0)
    """Distance of the policy's first action from the present pose that a person is warned of [rad]."""
    workspace: dict[str, WorkspaceBox] = Field(default_factory=dict)
    """Boxes by arm name; an action that leaves one is refused, never clamped. Motions of ours do not leave one that
    they are in."""
    collision: Literal["off", "warn", "refuse"] = "warn"
    """What becomes of a policy's action that brings links of the robot near each other or the table: an event, or a
    refusal unless it parts what is near already. Motions of ours are always refused then."""
    collision_margin: float = Field(default=MARGIN, ge=0, le=0.5)
    """Distance within which links count as colliding [m]; the capsules that stand for them cover them whole, so
    that little is needed on top."""

    @property
    def sagged(self) -> float:
        """Offset of an arm that its servo error alone may cause [rad]."""
        return _BESIDE if self.steady_error <= _BESIDE else self.steady_error + _NOISE
