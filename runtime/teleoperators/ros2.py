"""Leader on ROS 2 topics, over DDS without a ROS installation, or through rclpy."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import model_validator

from runtime.core.clock import Clock
from runtime.core.errors import ConfigurationError
from runtime.teleoperators.ros import NODE, TABLE, LeaderGroups, RosLeader
from runtime.transports import ros2
from runtime.transports.ros import cdr
from runtime.transports.ros.middleware import SENSOR_QUALITY, Quality

if TYPE_CHECKING:
    from robots import Robot


class Config(ros2.Link, LeaderGroups):
    """A leader whose arms publish on ROS 2 topics."""

    table: ClassVar[str] = TABLE
    kind: Literal["ros2"] = "ros2"
    qos: Quality = Quality()
    """Quality of service of all leader topics, if it differs from best effort; durability must be volatile."""

    @model_validator(mode="after")
    def _only_news(self) -> Config:
        if self.qos.durability != "volatile":
            raise ConfigurationError(
                f'{TABLE}.qos.durability = "{self.qos.durability}": an old pose would count as a new one; '
                'allowed: "volatile"'
            )
        return self


def build(config: Config, robot: Robot, clock: Clock) -> RosLeader:
    """Create the leader, not yet connected. Raises ConfigurationError for a group or joint that the robot lacks."""
    quality = config.qos.merged_over(SENSOR_QUALITY)
    return RosLeader(config, 2, robot, clock, quality, cdr, lambda: ros2.middleware(config, NODE))
