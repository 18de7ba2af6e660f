"""Settings that all LeRobot devices of a deployment share."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic import Field, JsonValue, field_validator

from robots.description import LerobotJointTable
from runtime.core.errors import ConfigurationError
from runtime.core.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from robots import Robot


class DeviceSettings(Settings):
    """LeRobot's device and the Python that runs it."""

    python: str = Field(default="/opt/lerobot/bin/python", min_length=1)
    """Python interpreter of an environment with lerobot, numpy, pyzmq and msgpack."""
    device: dict[str, JsonValue]
    """LeRobot's configuration of the device: its `type`, and the fields of that type, such as `port` and `id`."""

    @field_validator("device")
    @classmethod
    def _have_a_type(cls, device: dict[str, JsonValue]) -> dict[str, JsonValue]:
        if not isinstance(device.get("type"), str):
            raise ConfigurationError(
                f"device.type = {device.get('type')!r}; allowed: a type of LeRobot, such as 'koch_follower'"
            )
        return device


class JointDeviceSettings(DeviceSettings):
    """LeRobot's device with joints: a robot or a teleoperator."""

    joints: dict[str, dict[str, LerobotJointTable]] = Field(default_factory=dict)
    """Group of the robot = joint = feature of the device; absent joints: those of the robot's description."""
    rate: float | None = Field(default=None, gt=0, le=1000)
    """Readings per second [Hz]; absent: the robot's control rate."""

    def joint_tables(
        self, robot: Robot, groups: Iterable[str], table: str
    ) -> dict[str, dict[str, dict[str, Any]]]:
        """Return the features of all joints of `groups`, in the order of the robot's description.

        `table` is the deployment's table with these settings, for messages.

        Raises:
            ConfigurationError: A group or joint does not exist, or a joint has no feature.
        """
        own = robot.lerobot.joints if robot.lerobot is not None else {}
        allowed = {group.name: group.joints for group in robot.groups}
        for group, joints in self.joints.items():
            require_known(f"{table}.joints", [group], allowed, robot)
            require_known(f"{table}.joints.{group}", joints, allowed[group], robot)
        tables = {}
        for group in groups:
            features = {**own.get(group, {}), **self.joints.get(group, {})}
            if missing := [joint for joint in allowed[group] if joint not in features]:
                raise ConfigurationError(
                    f"{table}.joints.{group} lacks {', '.join(missing)}: neither the deployment nor the description "
                    f"of {robot.name} names their features"
                )
            tables[group] = {joint: features[joint].model_dump() for joint in allowed[group]}
        return tables


def require_known(
    key: str, names: Iterable[str], allowed: Mapping[str, Any] | Iterable[str], robot: Robot
) -> None:
    """Raise ConfigurationError if a name, given as `key` of the deployment, is not among those of the robot."""
    if unknown := [name for name in names if name not in allowed]:
        raise ConfigurationError(
            f"{key}: {', '.join(unknown)} not of {robot.name}; allowed: {', '.join(allowed)}"
        )
