"""A video file as a camera."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from runtime.cameras.base import Address, CameraSettings


class Config(CameraSettings):
    """A video that is played at its own pace: its first picture stands until a run begins."""

    kind: Literal["file"] = "file"
    path: str
    """The file: whatever FFmpeg reads."""
    at_end: Literal["loop", "stop"] = "loop"
    """"loop" goes on with its first picture; "stop" gives no more, until the next run begins."""


def address(config: Config) -> Address:
    """The file as it is."""
    path = Path(config.path).expanduser()
    return Address(f"file:{path}", str(path))
