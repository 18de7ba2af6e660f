"""Camera of this machine, through Video4Linux."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from runtime.cameras.base import Address, CameraSettings, Pixels


class Config(CameraSettings):
    """A USB camera of this machine (Linux)."""

    kind: Literal["v4l2"] = "v4l2"
    device: str = Field(pattern=r"^/dev/.+")
    """The device; /dev/v4l/by-id/NAME stays the same when cameras are plugged in another order."""
    frame_size: Annotated[list[Pixels], Field(min_length=2, max_length=2)] | None = None
    """Width and height that it is asked for; what it has where not given."""
    frame_rate: float | None = Field(default=None, gt=0, le=240)
    """Pictures per second that it is asked for [Hz]."""
    pixel_format: str | None = Field(default=None, pattern=r"^[a-z0-9_]+$")
    """What it is asked for, as FFmpeg names it: "mjpeg", "yuyv422"."""
    stamps: Literal["stream", "arrival"] = "stream"
    """When a picture was taken: as the driver says, mapped to our clock, or when it arrived."""


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
