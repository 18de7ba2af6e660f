"""Safety settings of a deployment."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from robots.clearance import MARGIN
from runtime.core.settings import Settings

_NOISE = 0.02  # [rad] margin on a configured `steady_error`
_BESIDE = 0.1  # [rad] least permitted offset of an arm


class WorkspaceBox(Settings):
    """A box in an arm's declared frame that its end effector must not leave [m]."""

    lower: list[float] = Field(min_length=3, max_length=3)
    """Corner with the smallest x, y and z."""
    upper: list[float] = Field(min_length=3, max_length=3)
    """Corner with the largest x, y and z."""


class SafetySettings(Settings):
    """Limits for every action; the defaults are derived from the values that a real demonstration reaches."""

    report_only: bool = False
    """Whether violations are only reported and actions sent unchanged; refused for a transport that can move a
    robot."""
    joint_age_s: float = Field(default=0.2, gt=0)
    """Greatest age of the joint measurement on which a policy action may be based [s]."""
    joint_gap_s: float = Field(default=1.0, ge=0)
    """Longest gap in the joint measurements after which a run that has stopped only for that reason resumes by itself,
    if the joints have not moved meanwhile [s]."""
    picture_age_s: float = Field(default=0.5, gt=0)
    """Greatest age of any camera's image on which a policy action may be based [s]."""
    following_error: float = Field(default=0.5, gt=0)
    """Largest distance of a target from the measured joints [rad]."""
    steady_error: float = Field(default=0.1, ge=0)
    """Largest steady distance of a joint from its command because of gravity and payload [rad]; an e-stop does not
    change the command of such a joint."""
    jump: float = Field(default=0.5, gt=0)
    """Largest distance of an action from the last command [rad]."""
    missed_pose: Literal["refuse", "flag"] = "refuse"
    """Response to a policy's pose that no joints reach within missed_pose_m and missed_pose_rad, or that is more than
    `jump` ahead of the joints reachable by then. "refuse" executes the rows before it, and holds if there are none;
    "flag" moves as close and as fast as the joints can, and reports it."""
    missed_pose_m: float = Field(default=0.02, gt=0)
    """Largest position error of the closest joints to a pose [m]."""
    missed_pose_rad: float = Field(default=0.2, gt=0)
    """Largest orientation error of the closest joints to a pose [rad]."""
    velocity_scale: float = Field(default=1.0, gt=0, le=1)
    """Share of the robot's joint velocity limits that may be used."""
    acceleration: float = Field(default=60.0, gt=0)
    """Largest joint acceleration of policy actions [rad/s2]."""
    motion_acceleration: float = Field(default=5.0, gt=0)
    """Joint acceleration of the station's own motions, such as homing [rad/s2]."""
    motion_velocity_scale: float = Field(default=0.3, gt=0, le=1)
    """Share of the joint velocity limits that the station's own motions use."""
    brake_acceleration: float = Field(default=20.0, gt=0)
    """Joint deceleration of a stop or hold [rad/s2]; up to `acceleration` if a joint limit is close."""
    refusals_to_hold: int = Field(default=10, ge=1)
    """Number of refused actions after which the robot holds: in a row, or among the last 2 * refusals_to_hold
    actions."""
    first_action_far: float = Field(default=0.3, gt=0)
    """Distance of the policy's first action from the current pose above which a person is warned [rad]."""
    workspace: dict[str, WorkspaceBox] = Field(default_factory=dict)
    """Boxes by arm name. A policy action outside its box is refused, never clamped; the station's own motions may not
    leave a box that they are in."""
    collision: Literal["off", "warn", "refuse"] = "warn"
    """Response to a policy action that brings links of the robot close to each other or to the table: "warn": an event;
    "refuse": a refusal, unless it separates links that are already close. The station's own motions are always treated
    as with "refuse"."""
    collision_margin: float = Field(default=MARGIN, ge=0, le=0.5)
    """Distance within which links count as colliding [m]. The capsules that represent links enclose them completely, so
    that a small margin is enough."""

    @property
    def sagged(self) -> float:
        """Largest distance between command and measurement that an arm's servo error alone may cause [rad]."""
        return _BESIDE if self.steady_error <= _BESIDE else self.steady_error + _NOISE
