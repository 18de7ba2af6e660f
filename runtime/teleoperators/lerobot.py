"""A teleoperator of LeRobot, any `Teleoperator` class that its environment has, in a process of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from runtime.core.clock import Clock
from runtime.core.errors import ConfigurationError
from runtime.lerobot.process import HostEndpoints, HostProcess, require_lerobot
from runtime.lerobot.settings import JointDeviceSettings
from runtime.teleoperators.zmq import ZmqLeader

if TYPE_CHECKING:
    from robots import Robot

_TABLE = "collection.leader"
_START_S = 60.0


class Config(JointDeviceSettings):
    """A teleoperator of LeRobot, in a process with LeRobot's own Python environment."""

    kind: Literal["lerobot"] = "lerobot"


def build(config: Config, robot: Robot, clock: Clock) -> LerobotLeader:
    """Create the leader, not yet connected. Raises ConfigurationError for a group or joint that the robot lacks."""
    return LerobotLeader(config, robot, clock)


class LerobotLeader(ZmqLeader):
    """Leader that owns the device's process. It leads the groups of `joints`, else those of the description."""

    def __init__(self, config: Config, robot: Robot, clock: Clock) -> None:
        own = robot.lerobot.joints if robot.lerobot is not None else {}
        led = [group.name for group in robot.groups if group.name in (config.joints or own)]
        joints = config.joint_tables(robot, led, _TABLE)
        if not joints:
            raise ConfigurationError(
                f"{_TABLE}.joints is missing: the description of {robot.name} names no features of LeRobot"
            )
        settings = {
            "role": "teleoperator",
            "device": config.device,
            "joints": joints,
            "rate": config.rate or robot.control_rate,
        }
        self._device, self._python = str(config.device["type"]), config.python
        endpoints = HostEndpoints.of_process(_TABLE)
        self._host = HostProcess(config.python, endpoints, settings)
        super().__init__(endpoints.observations, robot, clock)

    @property
    def name(self) -> str:
        return f"the leader {self._device}"

    def _capture_time(self, stamp: float) -> float:
        """Return the stamp, because both processes have one clock: a pose that waited is as old as it is."""
        return min(stamp, self._clock.now())

    @property
    def start_s(self) -> float:
        """As usual if the device has a problem, else longer, because importing LeRobot takes seconds."""
        return super().start_s if self._host.problem and not self._host.is_starting else _START_S

    def connect(self) -> None:
        """Start the device's process. Raises SetupError if LeRobot is not installed."""
        require_lerobot(self._python, f"{_TABLE}.python")
        super().connect()
        self._host.start()

    def close(self) -> None:
        self._host.stop()
        super().close()

    @property
    def problem(self) -> str:
        """Reason why the device gives nothing, else why its newest message could not be used, "" if it could."""
        return self._host.problem or super().problem
