"""Video file as a camera."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from runtime.cameras.base import Address, CameraSettings


class Config(CameraSettings):
    """A video file that every run plays from its first image at its own rate; that image is shown between runs."""

    kind: Literal["file"] = "file"
    path: str
    """Path of the file, in any format that FFmpeg reads."""
    at_end: Literal["loop", "stop"] = "loop"
    """At the end of the video, "loop" continues with its first image; "stop" delivers no more images until the run
    ends."""


def address(config: Config) -> Address:
    """Return the address of the file."""
    path = Path(config.path).expanduser()
    return Address(f"file:{path}", str(path))
