"""Video file as a camera."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from runtime.cameras.base import Address, CameraSettings


class Config(CameraSettings):
    """A video that every run plays from its first picture, at its own pace; between runs that picture stands."""

    kind: Literal["file"] = "file"
    path: str
    """The file: whatever FFmpeg reads."""
    at_end: Literal["loop", "stop"] = "loop"
    """"loop" goes on with its first picture; "stop" gives no more until the run is over."""


def address(config: Config) -> Address:
    """Return the address of the file."""
    path = Path(config.path).expanduser()
    return Address(f"file:{path}", str(path))
