"""Leader on ROS 1 topics, through rospy in a child process."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from runtime.core.clock import Clock
from runtime.teleoperators.ros import NODE, TABLE, LeaderGroups, RosLeader
from runtime.transports import ros1
from runtime.transports.ros import ros1_serialization
from runtime.transports.ros.middleware import Quality

if TYPE_CHECKING:
    from robots import Robot

_NEWEST = Quality(depth=1)


class Config(ros1.Link, LeaderGroups):
    """A leader whose arms publish on ROS 1 topics."""

    table: ClassVar[str] = TABLE
    kind: Literal["ros1"] = "ros1"


def build(config: Config, robot: Robot, clock: Clock) -> RosLeader:
    """Create the leader, not yet connected. Raises ConfigurationError for a group or joint that the robot lacks."""
    return RosLeader(
        config, 1, robot, clock, _NEWEST, ros1_serialization, lambda: ros1.middleware(config, NODE)
    )
