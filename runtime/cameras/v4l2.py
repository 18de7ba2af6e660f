"""Camera of this machine, through Video4Linux."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from runtime.cameras.base import Address, CameraSettings, Pixels


class Config(CameraSettings):
    """A USB camera of this machine (Linux)."""

    kind: Literal["v4l2"] = "v4l2"
    device: str = Field(pattern=r"^/dev/.+")
    """Device file; /dev/v4l/by-id/NAME does not change if cameras are plugged in in another order."""
    frame_size: Annotated[list[Pixels], Field(min_length=2, max_length=2)] | None = None
    """Width and height requested from the camera [pixels]; absent: its present setting."""
    frame_rate: float | None = Field(default=None, gt=0, le=240)
    """Image rate requested from the camera [Hz]."""
    pixel_format: str | None = Field(default=None, pattern=r"^[a-z0-9_]+$")
    """Pixel format requested from the camera, by its FFmpeg name, such as "mjpeg" or "yuyv422"."""
    stamps: Literal["stream", "arrival"] = "stream"
    """Capture time of an image: "stream" uses the time stamps of the driver, mapped to this machine's clock; "arrival"
    uses the time of arrival."""


def address(config: Config) -> Address:
    """Return the device with its options."""
    options = {}
    if config.frame_size is not None:
        options["video_size"] = "x".join(map(str, config.frame_size))
    if config.frame_rate is not None:
        options["framerate"] = f"{config.frame_rate:g}"
    if config.pixel_format is not None:
        options["input_format"] = config.pixel_format
    return Address(config.device, config.device, "v4l2", options, config.stamps == "stream")
