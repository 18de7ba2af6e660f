"""ROS 1 topics of a robot through rospy, which runs in a child process with a Python that has it.

ROS 1 has no protection: any peer that reaches the master or a node can command the robot. A master or an address beyond
this machine therefore needs `insecure_link`.
"""

from __future__ import annotations

import ipaddress
import re
from typing import TYPE_CHECKING, ClassVar, Literal
from urllib.parse import urlsplit

from pydantic import Field, model_validator

from runtime.core.clock import Clock
from runtime.core.errors import ConfigurationError
from runtime.core.settings import Settings
from runtime.transports.base import Capabilities
from runtime.transports.ros import ros1_serialization
from runtime.transports.ros.middleware import COMMAND_QUALITY, Middleware, Quality
from runtime.transports.ros.rospy_middleware import TcpRosMiddleware
from runtime.transports.ros.rospy_process import RosEnvironment, require
from runtime.transports.ros.settings import RosSettings, camera_keys
from runtime.transports.ros.sink import RosSink
from runtime.transports.ros.source import RosSource, Subscription, subscriptions
from runtime.transports.ros.topics import StreamSpec

if TYPE_CHECKING:
    from robots import Robot

NODE = "eva_web"
_NUMBERS = Quality(depth=50)  # queue_size: enough for a 200 Hz driver while this machine is busy
_PICTURES = Quality(depth=1)
REAL_TIME = True  # the robot does not wait for us


class Link(Settings):
    """Python interpreter and master of ROS 1, and the address of this machine."""

    table: ClassVar[str] = "transport"  # the deployment's table, for messages
    python: str = Field(default="/usr/bin/python3", min_length=1)
    """Python interpreter that has rospy; it needs no packages of EVA Web."""
    master: str = "http://127.0.0.1:11311"
    """The robot's ROS_MASTER_URI."""
    address: str = "127.0.0.1"
    """IP address of this machine at which the robot's nodes can reach it (ROS_IP)."""
    insecure_link: bool = False
    """Allow a master or an address beyond this machine, although anyone who reaches it can command the robot."""

    @model_validator(mode="after")
    def _stay_on_this_machine(self) -> Link:
        host = _host(self.table, self.master)
        try:
            address_here = ipaddress.ip_address(self.address).is_loopback
        except ValueError as error:
            raise ConfigurationError(
                f"{self.table}.address = {self.address!r} is no IP address; allowed: one of this machine's, which the "
                "robot's nodes can reach"
            ) from error
        master_here = host == "localhost" or host.startswith("127.") or host == "::1"
        if not (address_here and master_here) and not self.insecure_link:
            setting = f"address = {self.address!r}" if master_here else f"master = {self.master!r}"
            raise ConfigurationError(
                f"{self.table}.{setting} leaves this machine without protection; allowed: 127.0.0.1, or "
                "insecure_link = true on a network you trust"
            )
        if address_here and not master_here:
            raise ConfigurationError(
                f"{self.table}.master = {self.master!r} with address = {self.address!r}: the robot's nodes do not "
                "reach this machine there; allowed: this machine's address in the robot's network"
            )
        return self


class Config(Link, RosSettings):
    """A robot's ROS 1 topics."""

    kind: Literal["ros1"] = "ros1"


def capabilities(config: Config) -> Capabilities:
    """Return the abilities of the transport. Raises SetupError if rospy is not installed."""
    require(config.python)
    return config.capabilities


def cameras(config: Config, robot: Robot) -> tuple[str, ...]:
    """Return the keys of the robot's cameras in this deployment. Raises ConfigurationError if a topic is unknown."""
    parts, _ = config.streams(robot, 1)
    return camera_keys(parts)


def source(config: Config, robot: Robot, clock: Clock) -> RosSource:
    """Create the source of observations from the robot's topics. Raises ConfigurationError if a topic is unknown."""
    parts, _ = config.streams(robot, 1)
    opener = lambda: middleware(config, f"{NODE}_source")  # noqa: E731
    return RosSource(
        robot, _subscribed_topics(parts), config.acceptance_limits, clock, ros1_serialization, opener
    )


def sink(config: Config, robot: Robot, clock: Clock) -> RosSink:
    """Create the sink of commands to the robot's topics. Raises ConfigurationError if a topic is unknown."""
    _, outlets = config.streams(robot, 1)
    opener = lambda: middleware(config, f"{NODE}_commands")  # noqa: E731
    return RosSink(robot, outlets, lambda _: COMMAND_QUALITY, clock, ros1_serialization, opener)


def middleware(config: Link, name: str) -> Middleware:
    """Return a node that registers as soon as there is a master. Raises SetupError if rospy is not installed."""
    return TcpRosMiddleware(RosEnvironment(config.python, config.master, config.address), name)


def _subscribed_topics(parts: tuple[StreamSpec, ...]) -> tuple[Subscription, ...]:
    pictured = {part.topic for part in parts if part.kind == "camera"}
    return subscriptions(parts, lambda topic: _PICTURES if topic in pictured else _NUMBERS)


def _host(table: str, master: str) -> str:
    """Return the host of a master's URI; `table` is the configuration table that errors name.

    Raises ConfigurationError if the URI is invalid.
    """
    try:
        parts = urlsplit(master)
        fits = parts.scheme == "http" and parts.hostname and parts.port and parts.path in ("", "/")
    except ValueError:
        fits = False
    if not fits or not re.fullmatch(r"[A-Za-z0-9_.:\[\]/-]+", master):
        raise ConfigurationError(
            f"{table}.master = {master!r} is no ROS_MASTER_URI; allowed: one like http://10.0.0.7:11311"
        )
    return str(parts.hostname)
