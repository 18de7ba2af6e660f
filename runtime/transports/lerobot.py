"""A robot of LeRobot, any `Robot` class that its environment has, in a process of its own.

The process is an execution node with the wire of `kind = "zmq"`, and runs on this machine, so that both clocks are one.
Reception starts it; control only connects to it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

from runtime.core.clock import Clock
from runtime.core.sentences import Pattern
from runtime.lerobot.process import HostEndpoints, HostProcess, require_lerobot
from runtime.lerobot.settings import JointDeviceSettings, require_known
from runtime.transports.base import Capabilities
from runtime.transports.node_link import NodeSettings
from runtime.transports.node_sink import NodeSink
from runtime.transports.node_source import NodeSource

if TYPE_CHECKING:
    from robots import Robot

REAL_TIME = True  # the robot does not wait for us
_SILENT = Pattern(
    "lerobot.silent", "waiting for LeRobot's device {device}: nothing for {seconds:.1f} s: {why}"
)
_UNUSABLE = Pattern(
    "lerobot.unusable", "waiting for LeRobot's device {device}: nothing usable for {seconds:.1f} s: {why}"
)
_NO_ANSWER = "it is connected, and does not return from reading"


class Config(JointDeviceSettings):
    """A robot of LeRobot, in a process with LeRobot's own Python environment."""

    kind: Literal["lerobot"] = "lerobot"
    cameras: dict[str, str] = Field(default_factory=dict)
    """Observation key of a camera = name of the picture in the device's observations, if it is another."""
    disabled_cameras: list[str] = Field(default_factory=list)
    """Observation keys of cameras that this deployment does not use."""
    deadline_s: float = Field(default=0.3, gt=0, le=5)
    """Age of a command beyond which it is not executed, and silence after which the robot holds [s]."""
    detect_frozen: bool = True
    """Whether an image identical to the previous one counts as not new."""
    stalled_after_s: float = Field(default=1.0, gt=0)
    """Time without a usable message after which the missing data are reported [s]."""

    @property
    def endpoints(self) -> HostEndpoints:
        """Endpoints of this station's process. Raises TransportError if there is no usable folder."""
        return HostEndpoints.of_station(self.model_dump_json())


def capabilities(config: Config) -> Capabilities:
    """Return the abilities of the transport. Raises SetupError if LeRobot is not installed."""
    require_lerobot(config.python, "transport.python")
    return Capabilities(moves_robot=True)


def cameras(config: Config, robot: Robot) -> tuple[str, ...]:
    """Return the keys of the robot's cameras in this deployment.

    Raises ConfigurationError for an unknown camera or joint, or a joint without a feature.
    """
    known = [camera.key for camera in robot.cameras]
    for key, given in (("cameras", config.cameras), ("disabled_cameras", config.disabled_cameras)):
        require_known(f"transport.{key}", given, known, robot)
    config.joint_tables(robot, [group.name for group in robot.groups], "transport")
    return _enabled_cameras(config, robot)


def source(config: Config, robot: Robot, clock: Clock) -> LerobotSource:
    """Create the source of the device's observations. Raises ConfigurationError for a joint without a feature."""
    return LerobotSource(config, robot, clock)


def sink(config: Config, robot: Robot, clock: Clock) -> NodeSink:
    """Create the sink of commands to the device."""
    return NodeSink(config.endpoints.commands, robot, clock, says_source=True)


def _enabled_cameras(config: Config, robot: Robot) -> tuple[str, ...]:
    return tuple(camera.key for camera in robot.cameras if camera.key not in config.disabled_cameras)


class LerobotSource(NodeSource):
    """Source of observations, which owns the device's process."""

    def __init__(self, config: Config, robot: Robot, clock: Clock) -> None:
        endpoints = config.endpoints
        self._device = str(config.device["type"])
        settings = {
            "role": "robot",
            "device": config.device,
            "commands": endpoints.commands,
            "joints": config.joint_tables(robot, [group.name for group in robot.groups], "transport"),
            "cameras": {key: config.cameras.get(key, key) for key in _enabled_cameras(config, robot)},
            "rate": config.rate or robot.control_rate,
            "deadline_s": config.deadline_s,
            "same_clock": True,
        }
        self._host = HostProcess(config.python, endpoints, settings)
        node = NodeSettings(
            sub_endpoint=endpoints.observations,
            encoding="rgb",
            disabled_cameras=config.disabled_cameras,
            detect_frozen=config.detect_frozen,
            stalled_after_s=config.stalled_after_s,
        )
        super().__init__(node, robot, clock)

    def connect(self) -> None:
        super().connect()
        self._host.start()

    def close(self) -> None:
        self._host.stop()
        super().close()

    def faults(self) -> dict[str, int]:
        """Return the faults of the messages, and the number of readings that the process did not pass on."""
        return super().faults() | self._host.faults()

    def describe_fault(self, fault: str) -> str:
        return self._host.describe_fault(fault) or super().describe_fault(fault)

    def _silence_reason(self) -> str:
        return self._host.problem or _NO_ANSWER

    def _no_frame_reason(self, silent: float, refusal: str | None) -> str:
        fields = {"device": self._device, "seconds": silent}
        if refusal:
            return _UNUSABLE(**fields, why=refusal)
        return _SILENT(**fields, why=self._silence_reason())

    def _mapped(self, stamp: float, arrived: float) -> float | None:
        """Return the stamp itself: both processes have the same clock, and a delay that never varies is one too."""
        if stamp < self._stamp:
            return None
        self._stamp = stamp
        return min(stamp, arrived)
