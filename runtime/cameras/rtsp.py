"""Camera with RTSP, its pictures over the same TCP connection."""

from __future__ import annotations

from typing import Literal

from pydantic import field_validator

from runtime.cameras.base import Address, CameraSettings
from runtime.cameras.camera_urls import check_url, with_password


class Config(CameraSettings):
    """A network camera over RTSP."""

    kind: Literal["rtsp"] = "rtsp"
    url: str
    """Where it is: rtsp://host[:PORT]/PATH, without a password."""
    user: str | None = None
    """Name to log in with."""
    password_env: str | None = None
    """Environment variable that holds the password."""
    stamps: Literal["stream", "arrival"] = "stream"
    """When a picture was taken: as the stream says, mapped to our clock, or when it arrived."""

    @field_validator("url")
    @classmethod
    def _usable(cls, url: str) -> str:
        return check_url("url", url, ("rtsp", "rtsps"))


def address(config: Config) -> Address:
    """Return the address: video only, over TCP, because UDP loses packets; `timeout` [us] is FFmpeg's RTSP option."""
    options = {
        "rtsp_transport": "tcp",
        "allowed_media_types": "video",
        "timeout": str(int(max(config.open_s, config.read_s) * 1e6)),
    }
    url = with_password(config.url, config.user, config.password_env)
    return Address(url, config.url, "rtsp", options, config.stamps == "stream")
