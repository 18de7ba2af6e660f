"""ROS 2 topics of a robot: over DDS without a ROS installation, or through rclpy if that is installed.

Any peer in the network of a DDS domain can command the robot. A network beyond this machine therefore needs
`insecure_link`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field, model_validator

from runtime.core.clock import Clock
from runtime.core.errors import ConfigurationError
from runtime.core.settings import Settings
from runtime.transports.base import Capabilities
from runtime.transports.ros import cdr, dds_middleware, rclpy_middleware
from runtime.transports.ros.middleware import COMMAND_QUALITY, SENSOR_QUALITY, Middleware, Quality
from runtime.transports.ros.settings import RosSettings, camera_keys
from runtime.transports.ros.sink import RosSink
from runtime.transports.ros.source import RosSource, subscriptions
from runtime.transports.ros.topics import CommandTopic, StreamSpec

if TYPE_CHECKING:
    from robots import Robot

NODE = "eva_web"
REAL_TIME = True  # the robot does not wait for us


class Link(Settings):
    """Middleware, domain and network of ROS 2."""

    table: ClassVar[str] = "transport"  # the deployment's table, for messages
    middleware: Literal["dds", "rclpy"] = "dds"
    """"dds" needs no ROS installation but the extra ros2; "rclpy" needs a ROS 2 installation for the Python that runs
    this program, and insecure_link."""
    domain: int = Field(default=0, ge=0, le=232)
    """The robot's ROS_DOMAIN_ID."""
    network: str = Field(default="loopback", min_length=1)
    """"loopback", the name or address of a network interface, or "environment" for the configuration in
    $CYCLONEDDS_URI."""
    peers: list[str] = Field(default_factory=list)
    """Addresses at which nodes are searched in addition to multicast; only if `network` is an interface."""
    insecure_link: bool = False
    """Allow a network beyond this machine, although anyone on it can command the robot."""

    @model_validator(mode="after")
    def _stay_on_this_machine(self) -> Link:
        elsewhere = self.network != dds_middleware.LOOPBACK or self.middleware == "rclpy"
        if elsewhere and not self.insecure_link:
            setting = f"network = {self.network!r}" if self.middleware == "dds" else 'middleware = "rclpy"'
            raise ConfigurationError(
                f"{self.table}.{setting} may leave this machine without protection; allowed: "
                'middleware = "dds" with network = "loopback", or insecure_link = true on a network you trust'
            )
        if self.peers and self.network in (dds_middleware.LOOPBACK, dds_middleware.ENVIRONMENT):
            raise ConfigurationError(
                f"{self.table}.peers = {self.peers} with network = {self.network!r}; allowed: with an interface"
            )
        wrong = [peer for peer in (*self.peers, self.network) if not re.fullmatch(r"[A-Za-z0-9_.:%-]+", peer)]
        if wrong:
            raise ConfigurationError(f"{self.table}: {wrong[0]!r} is no interface or address")
        return self


class Config(Link, RosSettings):
    """A robot's ROS 2 topics."""

    kind: Literal["ros2"] = "ros2"
    qos: dict[str, Quality] = Field(default_factory=dict)
    """Quality of service by name of the topic."""


def capabilities(config: Config) -> Capabilities:
    """Return the abilities of the transport. Raises SetupError if the middleware is not installed."""
    (dds_middleware.require if config.middleware == "dds" else rclpy_middleware.require)()
    return config.capabilities


def cameras(config: Config, robot: Robot) -> tuple[str, ...]:
    """Return the keys of the robot's cameras in this deployment. Raises ConfigurationError if a topic is unknown."""
    parts, _ = _checked(config, robot)
    return camera_keys(parts)


def source(config: Config, robot: Robot, clock: Clock) -> RosSource:
    """Create the source of observations from the robot's topics. Raises ConfigurationError if a topic is unknown."""
    parts, _ = _checked(config, robot)
    subscribed = subscriptions(parts, _quality(config, SENSOR_QUALITY))
    return RosSource(
        robot, subscribed, config.acceptance_limits, clock, cdr, lambda: middleware(config, f"{NODE}_source")
    )


def sink(config: Config, robot: Robot, clock: Clock) -> RosSink:
    """Create the sink of commands to the robot's topics. Raises ConfigurationError if a topic is unknown."""
    _, outlets = _checked(config, robot)
    quality = _quality(config, COMMAND_QUALITY)
    return RosSink(robot, outlets, quality, clock, cdr, lambda: middleware(config, f"{NODE}_commands"))


def middleware(config: Link, name: str) -> Middleware:
    """Return a node of the chosen middleware. Raises SetupError if that is not installed."""
    if config.middleware == "rclpy":
        return rclpy_middleware.RclMiddleware(config.domain, name)
    return dds_middleware.DdsMiddleware(config.domain, config.network, tuple(config.peers))


def _checked(config: Config, robot: Robot) -> tuple[tuple[StreamSpec, ...], tuple[CommandTopic, ...]]:
    """Return the subscribed streams and the command topics, after checking the keys and durability of `qos`."""
    parts, outlets = config.streams(robot, 2)
    subscribed, published = {part.topic for part in parts}, {outlet.topic for outlet in outlets}
    unknown = sorted(set(config.qos) - subscribed - published)
    if unknown:
        raise ConfigurationError(
            f"transport.qos: {', '.join(unknown)} are no topics of this deployment; "
            f"allowed: {', '.join(sorted(subscribed | published))}"
        )
    late = sorted(
        topic for topic in published & set(config.qos) if config.qos[topic].durability != "volatile"
    )
    if late:
        raise ConfigurationError(
            f'transport.qos."{late[0]}".durability = "transient_local": a robot that starts would obey an old '
            'command; allowed: "volatile"'
        )
    return parts, outlets


def _quality(config: Config, usual: Quality) -> Callable[[str], Quality]:
    return lambda topic: config.qos.get(topic, Quality()).merged_over(usual)
