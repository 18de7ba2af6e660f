"""ZMQ link to an execution node, to which we connect; single frames over PUB and SUB sockets, with openpi's arrays.

The protocol has no handshake, authentication or encryption, so endpoints beyond loopback need `insecure_link`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import model_validator

from runtime.core.clock import Clock
from runtime.core.errors import ConfigurationError
from runtime.core.node_sockets import is_loopback
from runtime.transports.base import Capabilities
from runtime.transports.node_link import Endpoint, NodeSettings
from runtime.transports.node_sink import NodeSink
from runtime.transports.node_source import NodeSource

if TYPE_CHECKING:
    from robots import Robot

REAL_TIME = True  # the node does not wait for us


class Config(NodeSettings):
    """An execution node over ZMQ."""

    kind: Literal["zmq"] = "zmq"
    pub_endpoint: Endpoint = "tcp://127.0.0.1:5556"
    """ZMQ endpoint at which the node receives commands."""
    insecure_link: bool = False
    """Allow endpoints beyond this machine, although anyone on that network can command the robot."""

    @model_validator(mode="after")
    def _stay_on_this_machine(self) -> Config:
        for key in ("sub_endpoint", "pub_endpoint"):
            endpoint = getattr(self, key)
            if endpoint.startswith("tcp://") and not _has_port(endpoint):
                raise ConfigurationError(
                    f"transport.{key} = {endpoint!r}; allowed: tcp://HOST:PORT with a port from 1 to 65535"
                )
            if not self.insecure_link and not is_loopback(endpoint):
                raise ConfigurationError(
                    f"transport.{key} = {endpoint!r} leaves this machine over a plain link; "
                    "allowed: a loopback address, or insecure_link = true on a network you trust"
                )
        return self


def _has_port(endpoint: str) -> bool:
    """Return True if the endpoint has a valid port; libzmq accepts any number and then waits without an error."""
    port = endpoint.rpartition(":")[2]
    return port.isascii() and port.isdigit() and 0 < int(port) < 65536


def capabilities(config: Config) -> Capabilities:
    """Return the abilities of a node.

    It may command a real robot, send measured poses, follow its own leader and, if declared simulated, reset its bench.
    """
    return Capabilities(
        moves_robot=True,
        measures_eef=True,
        drives_itself=True,
        bench=config.bench if config.simulated else "",
    )


def cameras(config: Config, robot: Robot) -> tuple[str, ...]:
    """Return the keys of the robot's cameras in this deployment."""
    return tuple(camera.key for camera in robot.cameras if camera.key not in config.disabled_cameras)


def source(config: Config, robot: Robot, clock: Clock) -> NodeSource:
    """Create the source of the node's observations. Raises ConfigurationError for an unknown disabled camera."""
    robot_cameras = [camera.key for camera in robot.cameras]
    unknown = [key for key in config.disabled_cameras if key not in robot_cameras]
    if unknown:
        raise ConfigurationError(
            f"transport.disabled_cameras = {unknown} are no cameras of {robot.name}; "
            f"allowed: {', '.join(robot_cameras)}"
        )
    return NodeSource(config, robot, clock)


def sink(config: Config, robot: Robot, clock: Clock) -> NodeSink:
    """Create the sink of commands to the node."""
    return NodeSink(config.pub_endpoint, robot, clock, config.simulated)
