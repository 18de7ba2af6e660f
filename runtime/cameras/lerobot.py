"""Camera of LeRobot, any `Camera` class that its environment has, in a process of its own."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from runtime.cameras.base import Address, CameraSettings
from runtime.lerobot.settings import DeviceSettings


class Config(DeviceSettings, CameraSettings):
    """A camera of LeRobot, in a process with LeRobot's own Python environment."""

    kind: Literal["lerobot"] = "lerobot"
    open_s: float = Field(default=30.0, gt=0, le=60)
    """Longest time for opening the camera [s]; beyond it the attempt has failed and is repeated. LeRobot alone needs
    seconds."""


def address(config: Config) -> Address:
    """Return the type of the device; FFmpeg does not open it."""
    return Address("", str(config.device["type"]))
