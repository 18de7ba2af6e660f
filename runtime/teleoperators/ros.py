"""Leader on ROS 1 or ROS 2 topics: a sensor_msgs/JointState for each group of the robot that it leads."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field

from runtime.core.clock import Clock
from runtime.core.errors import CodecError, ConfigurationError
from runtime.core.settings import Settings
from runtime.core.types import Float64
from runtime.teleoperators.base import Leader
from runtime.transports.ros.message_reading import JointOrder, Names
from runtime.transports.ros.messages import JointState, Wire
from runtime.transports.ros.middleware import Match, Middleware, Quality
from runtime.transports.ros.source import Subscription, subscriptions
from runtime.transports.ros.topics import StreamSpec

if TYPE_CHECKING:
    from robots import Group, Robot
    from robots.description import RosGroupTable

NODE = "eva_web_leader"
TABLE = "collection.leader"


class LeaderGroup(Settings):
    """Topic and joints of the leader of one group."""

    topic: Annotated[str, Field(pattern=r"^(/[A-Za-z_][A-Za-z0-9_]*)+$")] | None = None
    """Topic of type sensor_msgs/JointState, with the gripper among its values; absent: the group's `leader` in the
    robot's description."""
    joints: list[str] | None = None
    """Names of the group's joints in the messages, in the group's order; absent: those of the robot's description."""


class LeaderGroups(Settings):
    """Settings of a leader common to ROS 1 and ROS 2."""

    groups: dict[str, LeaderGroup] = Field(min_length=1)
    """Topics and joints by name of the robot's group; an absent group is not led."""
    joint_names: Names = "check"
    """"check" assigns joints by their names, in any order; "ignore" uses the first values in the order received."""


class RosLeader(Leader):
    """Leader with one topic per group, or one topic for several groups.

    There is a new pose once every topic has sent a new message; its age is that of the oldest of them. A message with
    the stamp of its predecessor is not new: a publisher that only repeats itself counts as silent. Messages without a
    stamp are always new.
    """

    def __init__(
        self,
        config: LeaderGroups,
        version: Literal[1, 2],
        robot: Robot,
        clock: Clock,
        quality: Quality,
        wire: Wire,
        open_middleware: Callable[[], Middleware],
    ) -> None:
        super().__init__(robot, clock)
        self._groups = _groups_by_name(config.groups, robot)
        own = robot.ros.groups if robot.ros is not None and robot.ros.version == version else {}
        self._parts = {
            name: _part(self._groups[name], led, own.get(name)) for name, led in config.groups.items()
        }
        self._names, self._quality, self._wire, self._open = (
            config.joint_names,
            quality,
            wire,
            open_middleware,
        )
        self._middleware: Middleware | None = None
        self._begin()

    @property
    def name(self) -> str:
        return f"the leader on {', '.join(part.topic for part in self._parts.values())}"

    def connect(self) -> None:
        self.close()
        self._forget()
        self._begin()
        self._middleware = self._open()
        for stream in subscriptions(tuple(self._parts.values()), lambda _: self._quality):
            self._middleware.subscribe(stream.topic, self._make_callback(stream))

    def close(self) -> None:
        if self._middleware is not None:
            self._middleware.close()
            self._middleware = None

    @property
    def problem(self) -> str:
        """Reason why a message could not be used, else a sentence on each topic that has no new messages.

        It is "" if there are new messages on all topics.
        """
        if problem := super().problem:
            return problem
        waiting = [part.topic for group, part in self._parts.items() if group not in self._fresh]
        if self._middleware is None or not waiting:
            return ""
        matches = self._middleware.matches()
        return "; ".join(_silence(topic, matches.get(topic, Match(0))) for topic in waiting)

    def _begin(self) -> None:
        self._orders = {
            name: JointOrder(part, self._names, f"{TABLE}.groups") for name, part in self._parts.items()
        }
        self._stamps: dict[str, int] = {}  # stamp of the newest message by topic
        self._fresh: dict[str, tuple[Float64, float]] = {}  # by group: joints and their arrival time

    def _make_callback(self, stream: Subscription) -> Callable[[bytes], None]:
        topic = stream.topic.name

        def take(payload: bytes) -> None:
            arrived = self._clock.now()
            try:
                message = self._wire.decode("JointState", payload)
                assert isinstance(message, JointState)
                if message.stamp and message.stamp == self._stamps.get(topic):
                    return
                self._stamps[topic] = message.stamp
                state = {
                    part.source_key: self._orders[part.source_key].read(message)[0] for part in stream.parts
                }
            except CodecError as error:
                self._refuse(f"{topic}: {error}")
                return
            for group, position in state.items():
                self._add_reading(group, position, arrived)

        return take

    def _add_reading(self, group: str, position: Float64, arrived: float) -> None:
        self._fresh[group] = position, arrived
        if len(self._fresh) < len(self._parts):
            return
        joints = np.full(self._robot.dim, np.nan)
        for name, (numbers, _) in self._fresh.items():
            joints[self._groups[name].slice] = numbers
        oldest = min(when for _, when in self._fresh.values())
        self._fresh.clear()
        self._set_pose(joints, oldest)


def _silence(topic: str, match: Match) -> str:
    if match.peers:
        return f"{topic}: no new message"
    return match.refused or f"{topic} has no publisher"


def _groups_by_name(led: Mapping[str, LeaderGroup], robot: Robot) -> dict[str, Group]:
    groups = {group.name: group for group in robot.groups}
    unknown = [name for name in led if name not in groups]
    if unknown:
        raise ConfigurationError(
            f"{TABLE}.groups: {', '.join(unknown)} not of {robot.name}; allowed: {', '.join(groups)}"
        )
    return groups


def _part(group: Group, led: LeaderGroup, own: RosGroupTable | None) -> StreamSpec:
    names = group.joints if led.joints is None else tuple(led.joints)
    if len(names) != group.dof or len(set(names)) != len(names):
        raise ConfigurationError(
            f"{TABLE}.groups.{group.name}.joints = {list(names)}; "
            f"allowed: {group.dof} different names, in the order of {', '.join(group.joints)}"
        )
    topic = led.topic or (own.leader if own is not None else None)
    if topic is None:
        raise ConfigurationError(
            f"{TABLE}.groups.{group.name}.topic is missing, and the robot's description names no `leader` of that group"
        )
    return StreamSpec("joints", group.name, topic, "JointState", names)
