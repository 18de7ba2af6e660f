"""Camera that is read by RTSP, with the pictures over the same TCP connection."""

from __future__ import annotations

from typing import Literal

from pydantic import field_validator

from runtime.cameras.base import Address, CameraSettings
from runtime.cameras.camera_urls import check_url, with_password


class Config(CameraSettings):
    """A network camera over RTSP."""

    kind: Literal["rtsp"] = "rtsp"
    url: str
    """Address of the camera without a password: rtsp://host[:PORT]/PATH or rtsps://host[:PORT]/PATH."""
    user: str | None = None
    """User name for the login."""
    password_env: str | None = None
    """Name of the environment variable that contains the password."""
    stamps: Literal["stream", "arrival"] = "stream"
    """Capture time of an image: "stream" uses the time stamps of the stream, mapped to this machine's clock; "arrival"
    uses the time of arrival."""

    @field_validator("url")
    @classmethod
    def _usable(cls, url: str) -> str:
        return check_url("url", url, ("rtsp", "rtsps"))


def address(config: Config) -> Address:
    """Return the camera's address with FFmpeg's options: video only, over TCP because UDP loses packets.

    `timeout` [us] is FFmpeg's RTSP option.
    """
    options = {
        "rtsp_transport": "tcp",
        "allowed_media_types": "video",
        "timeout": str(int(max(config.open_s, config.read_s) * 1e6)),
    }
    url = with_password(config.url, config.user, config.password_env)
    return Address(url, config.url, "rtsp", options, config.stamps == "stream")
