"""Camera that sends JPEG pictures in one HTTP response."""

from __future__ import annotations

from typing import Literal

from pydantic import field_validator

from runtime.cameras.base import Address, CameraSettings
from runtime.cameras.camera_urls import check_url, with_password


class Config(CameraSettings):
    """A network camera over HTTP, multipart/x-mixed-replace ("MJPEG"); images are stamped on arrival."""

    kind: Literal["mjpeg"] = "mjpeg"
    url: str
    """Address of the camera without a password: http://host[:PORT]/PATH or https://host[:PORT]/PATH."""
    user: str | None = None
    """User name for the login."""
    password_env: str | None = None
    """Name of the environment variable that contains the password."""

    @field_validator("url")
    @classmethod
    def _usable(cls, url: str) -> str:
        return check_url("url", url, ("http", "https"))


def address(config: Config) -> Address:
    """Return the camera's address; `rw_timeout` [us] bounds each read and write. These streams have no time stamps."""
    options = {"rw_timeout": str(int(max(config.open_s, config.read_s) * 1e6))}
    url = with_password(config.url, config.user, config.password_env)
    return Address(url, config.url, "mpjpeg", options, stamped=False)
