"""Camera that sends JPEG pictures in one HTTP response."""

from __future__ import annotations

from typing import Literal

from pydantic import field_validator

from runtime.cameras.base import Address, CameraSettings
from runtime.cameras.camera_urls import check_url, with_password


class Config(CameraSettings):
    """A network camera over HTTP, multipart/x-mixed-replace ("MJPEG"); a picture counts as taken when it arrives."""

    kind: Literal["mjpeg"] = "mjpeg"
    url: str
    """Where it is: http://host[:PORT]/PATH, without a password."""
    user: str | None = None
    """Name to log in with."""
    password_env: str | None = None
    """Environment variable that holds the password."""

    @field_validator("url")
    @classmethod
    def _usable(cls, url: str) -> str:
        return check_url("url", url, ("http", "https"))


def address(config: Config) -> Address:
    """Return the address; `rw_timeout` [us] bounds each read and write. These streams carry no time of their own."""
    options = {"rw_timeout": str(int(max(config.open_s, config.read_s) * 1e6))}
    url = with_password(config.url, config.user, config.password_env)
    return Address(url, config.url, "mpjpeg", options, stamped=False)
