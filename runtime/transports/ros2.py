"""A robot's own ROS 2 topics: over DDS without a ROS installation, or through rclpy where that is installed.

Anybody on the network of a DDS domain can command the robot, so beyond this machine it must be asked for.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

from pydantic import Field, model_validator

from runtime.clock import Clock
from runtime.errors import ConfigurationError
from runtime.pose_format import PoseFormat
from runtime.section import Section
from runtime.transports.base import Capabilities
from runtime.transports.ros import cdr, dds, rcl
from runtime.transports.ros.middleware import COMMAND_QUALITY, SENSOR_QUALITY, Middleware, Quality
from runtime.transports.ros.reading import Names
from runtime.transports.ros.sink import RosSink
from runtime.transports.ros.source import RosSource, Terms, subscriptions
from runtime.transports.ros.topics import Outlet, Part, Target, TopicPlan, Topics

if TYPE_CHECKING:
    from robots import Robot

NODE = "eva_web"


class Config(Section):
    """A robot's ROS 2 topics."""

    kind: Literal["ros2"] = "ros2"
    middleware: Literal["dds", "rclpy"] = "dds"
    """"dds" needs no ROS but the extra ros2; "rclpy" needs a ROS 2 whose Python is the one that runs this."""
    domain: int = Field(default=0, ge=0, le=232)
    """The robot's ROS_DOMAIN_ID."""
    network: str = Field(default="loopback", min_length=1)
    """"loopback", the name or address of a network interface, or "environment" for what $CYCLONEDDS_URI says."""
    peers: list[str] = Field(default_factory=list)
    """Addresses where nodes are looked for besides multicast; not on loopback."""
    insecure_link: bool = False
    """Allow a network beyond this machine although anybody on it can command the robot."""
    topics: Topics = Topics()
    """Topics that are not those of the robot's description."""
    disabled_cameras: list[str] = Field(default_factory=list)
    """Observation keys of cameras that this deployment does without."""
    eef: bool = False
    """Listen to the poses that the robot measures of its end effectors; frames wait for them."""
    eef_commands: bool = False
    """Publish poses to the robot's `eef_command` topics; needs publication.space = "eef"."""
    commands_to: list[Target] = Field(default_factory=lambda: ["robot"], min_length=1, max_length=2)  # type: ignore[arg-type]
    """Who is told: the robot, a simulation beside it on the robot's `simulation` topics, or both."""
    max_skew_s: float = Field(default=0.1, gt=0, le=5)
    """How far apart in time the messages of one observation may be [s]."""
    stalled_after_s: float = Field(default=0.5, gt=0)
    """Silence of a topic after which it is named [s]."""
    stamps: Literal["header", "arrival"] = "header"
    """When a message was made: what its header says, or its arrival, for drivers that do not stamp."""
    joint_names: Names = "check"
    """"check" takes joints by their names, in any order; "ignore" takes the first numbers as they come."""
    detect_frozen: bool = True
    """A picture exactly like the one before counts as no newer; off for simulated cameras that may stand still."""
    qos: dict[str, Quality] = Field(default_factory=dict)
    """By the name of the topic."""

    @model_validator(mode="after")
    def _stay_on_this_machine(self) -> Config:
        elsewhere = self.network != dds.LOOPBACK or self.middleware == "rclpy"
        if elsewhere and not self.insecure_link:
            what = f"network = {self.network!r}" if self.middleware == "dds" else 'middleware = "rclpy"'
            raise ConfigurationError(
                f"transport.{what} may leave this machine without protection; allowed: "
                'middleware = "dds" with network = "loopback", or insecure_link = true on a network you trust'
            )
        if self.peers and self.network in (dds.LOOPBACK, dds.ENVIRONMENT):
            raise ConfigurationError(
                f"transport.peers = {self.peers} with network = {self.network!r}; allowed: with an interface"
            )
        wrong = [peer for peer in (*self.peers, self.network) if not re.fullmatch(r"[A-Za-z0-9_.:%-]+", peer)]
        if wrong:
            raise ConfigurationError(f"transport: {wrong[0]!r} is no interface or address")
        return self

    @model_validator(mode="after")
    def _command_each_once(self) -> Config:
        """Each target is told once."""
        if len(set(self.commands_to)) != len(self.commands_to):
            raise ConfigurationError(
                f"transport.commands_to = {self.commands_to}; allowed: each at most once"
            )
        return self


def capabilities(config: Config) -> Capabilities:
    """A robot hangs on it; SetupError where the middleware is not installed."""
    (dds.require if config.middleware == "dds" else rcl.require)()
    spaces = frozenset({"joint", "eef"}) if config.eef_commands else frozenset({"joint"})
    return Capabilities(moves_robot=True, measures_eef=config.eef, spaces=spaces, poses=(PoseFormat(),))


def cameras(config: Config, robot: Robot) -> tuple[str, ...]:
    """Keys of the robot's cameras that this deployment has; ConfigurationError where any topic is not known."""
    parts, _ = _checked(config, robot)
    return tuple(part.of for part in parts if part.kind == "camera")


def source(config: Config, robot: Robot, clock: Clock) -> RosSource:
    """The robot's topics as observations; ConfigurationError names a topic that is not known."""
    parts, _ = _checked(config, robot)
    terms = Terms(
        config.max_skew_s,
        config.stalled_after_s,
        config.joint_names,
        config.stamps == "header",
        config.detect_frozen,
    )
    heard = subscriptions(parts, _quality(config, SENSOR_QUALITY))
    return RosSource(robot, heard, terms, clock, cdr, lambda: middleware(config, f"{NODE}_source"))


def sink(config: Config, robot: Robot, clock: Clock) -> RosSink:
    """Commands to the robot's topics; ConfigurationError names a topic that is not known."""
    _, outlets = _checked(config, robot)
    quality = _quality(config, COMMAND_QUALITY)
    return RosSink(robot, outlets, quality, clock, cdr, lambda: middleware(config, f"{NODE}_commands"))


def middleware(config: Config, name: str) -> Middleware:
    """A node of the middleware that is chosen; SetupError where it is not installed."""
    if config.middleware == "rclpy":
        return rcl.RclMiddleware(config.domain, name)
    return dds.DdsMiddleware(config.domain, config.network, tuple(config.peers))


def _checked(config: Config, robot: Robot) -> tuple[tuple[Part, ...], tuple[Outlet, ...]]:
    """What is listened to and what is spoken on, the simulation's topics first."""
    plan = TopicPlan(robot, 2, config.topics, config.disabled_cameras)
    parts = plan.parts(config.eef)
    chosen: list[Target] = [target for target in ("simulation", "robot") if target in config.commands_to]
    outlets = plan.outlets(chosen, config.eef_commands)
    heard, told = {part.topic for part in parts}, {outlet.topic for outlet in outlets}
    unknown = sorted(set(config.qos) - heard - told)
    if unknown:
        raise ConfigurationError(
            f"transport.qos: {', '.join(unknown)} are no topics of this deployment; "
            f"allowed: {', '.join(sorted(heard | told))}"
        )
    late = sorted(topic for topic in told & set(config.qos) if config.qos[topic].durability != "volatile")
    if late:
        raise ConfigurationError(
            f'transport.qos."{late[0]}".durability = "transient_local": a robot that starts would obey an old '
            'command; allowed: "volatile"'
        )
    return parts, outlets


def _quality(config: Config, usual: Quality) -> Callable[[str], Quality]:
    return lambda topic: config.qos.get(topic, Quality()).otherwise(usual)
