"""Deployment settings of a robot's ROS topics, for both generations of ROS."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field, model_validator

from runtime.core.errors import ConfigurationError
from runtime.core.pose_format import PoseFormat
from runtime.core.settings import Settings
from runtime.transports.base import Capabilities
from runtime.transports.ros.message_reading import Names
from runtime.transports.ros.source import AcceptanceLimits
from runtime.transports.ros.topics import CommandTopic, StreamSpec, Target, TopicPlan, Topics

if TYPE_CHECKING:
    from robots import Robot


class RosSettings(Settings):
    """Transport settings common to ROS 1 and ROS 2."""

    topics: Topics = Topics()
    """Topics that differ from those in the robot's description."""
    disabled_cameras: list[str] = Field(default_factory=list)
    """Observation keys of cameras that this deployment does not use."""
    eef: bool = False
    """Whether to subscribe to the end-effector poses that the robot measures; observations then wait for them."""
    eef_commands: bool = False
    """Whether to publish poses to the robot's `eef_command` topics; needs publication.space = "eef"."""
    commands_to: list[Target] = Field(default_factory=lambda: ["robot"], min_length=1, max_length=2)  # type: ignore[arg-type]
    """Recipients of commands: the robot, a simulation in parallel on the robot's `simulation` topics, or both."""
    max_skew_s: float = Field(default=0.1, gt=0, le=5)
    """Largest difference between the times of the messages of one observation [s]."""
    stalled_after_s: float = Field(default=0.5, gt=0)
    """Silence of a topic after which it is reported [s]."""
    stamps: Literal["header", "arrival"] = "header"
    """Time of a message: "header" uses the stamp in its header; "arrival" its arrival, for drivers that set no
    stamp."""
    joint_names: Names = "check"
    """"check" assigns joints by their names, in any order; "ignore" uses the first values in the order received."""
    detect_frozen: bool = True
    """Whether an image identical to the previous one counts as not new; false for simulated cameras whose images may be
    constant."""

    @model_validator(mode="after")
    def _command_each_once(self) -> RosSettings:
        """Check that no target of commands is named twice."""
        if len(set(self.commands_to)) != len(self.commands_to):
            raise ConfigurationError(
                f"transport.commands_to = {self.commands_to}; allowed: each at most once"
            )
        return self

    @property
    def acceptance_limits(self) -> AcceptanceLimits:
        """Limits within which messages are accepted, according to these settings."""
        return AcceptanceLimits(
            self.max_skew_s,
            self.stalled_after_s,
            self.joint_names,
            self.stamps == "header",
            self.detect_frozen,
        )

    @property
    def capabilities(self) -> Capabilities:
        """Abilities of the transport: it commands a robot."""
        spaces = frozenset({"joint", "eef"}) if self.eef_commands else frozenset({"joint"})
        return Capabilities(moves_robot=True, measures_eef=self.eef, spaces=spaces, poses=(PoseFormat(),))

    def streams(
        self, robot: Robot, version: Literal[1, 2]
    ) -> tuple[tuple[StreamSpec, ...], tuple[CommandTopic, ...]]:
        """Return the subscribed streams, and the command topics with those of the simulation first."""
        plan = TopicPlan(robot, version, self.topics, self.disabled_cameras)
        parts = plan.streams(self.eef)
        chosen: list[Target] = [target for target in ("simulation", "robot") if target in self.commands_to]
        return parts, plan.command_topics(chosen, self.eef_commands)


def camera_keys(parts: tuple[StreamSpec, ...]) -> tuple[str, ...]:
    """Return the keys of the cameras among the subscribed streams."""
    return tuple(part.source_key for part in parts if part.kind == "camera")
