"""Camera interface: settings, address, newest picture, health."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from runtime.core.errors import ConfigurationError, TransportError
from runtime.core.sentences import Pattern
from runtime.core.settings import Settings
from runtime.core.types import UInt8

LARGEST = 1920 * 1080 * 3  # bytes of a picture after processing

Pixels = Annotated[int, Field(ge=8, le=4096)]
Offset = Annotated[int, Field(ge=0, le=8192)]


class CameraError(TransportError):
    """Error about a camera that cannot be opened, is lost, or sends unusable pictures; its message states the cause."""


class CameraSettings(Settings):
    """Image processing and deadlines common to all cameras; the order is colours, crop, rotate, flip, size."""

    colours: Literal["rgb", "bgr"] = "rgb"
    """Order of the colour channels; "bgr" for a camera that swaps red and blue."""
    crop: Annotated[list[Offset], Field(min_length=4, max_length=4)] | None = None
    """Region that is used: left, top, width, height in the camera's own pixels; width and height at least 8. Absent:
    the whole image."""
    rotate: Literal[0, 90, 180, 270] = 0
    """Clockwise rotation of the image [degrees]."""
    flip: Literal["none", "horizontal", "vertical"] = "none"
    """Mirroring after the rotation: "horizontal" swaps left and right, "vertical" swaps top and bottom."""
    size: Annotated[list[Pixels], Field(min_length=2, max_length=2)] | None = None
    """Width and height to which the image is scaled [pixels]; absent: it is not scaled."""
    open_s: float = Field(default=5.0, gt=0, le=60)
    """Longest time for opening the camera [s]; beyond it the attempt has failed and is repeated."""
    read_s: float = Field(default=2.0, gt=0, le=60)
    """Longest time without an image [s]; beyond it the camera counts as lost and is opened again."""

    @model_validator(mode="after")
    def _crop_something(self) -> CameraSettings:
        if self.crop is not None and min(self.crop[2:]) < 8:
            raise ConfigurationError(
                f"crop = {self.crop} leaves {self.crop[2]}x{self.crop[3]}; allowed: at least 8x8 pixels"
            )
        return self


@dataclass(frozen=True, slots=True)
class Address:
    """Address of a camera's pictures for FFmpeg: URL, input format and options.

    `shown` is the URL for display, without a password.
    """

    url: str = field(repr=False)  # may hold a password
    shown: str  # for display, without a password
    format: str | None = None
    options: Mapping[str, str] = field(default_factory=dict)
    stamped: bool = True  # the stream carries capture times


@dataclass(frozen=True, slots=True)
class CapturedImage:
    """One picture uint8 [H, W, 3] RGB, with its capture and arrival time on our clock [s]."""

    picture: UInt8
    captured: float
    arrived: float


class CameraCondition(StrEnum):
    """Condition of a camera."""

    OPENING = "opening"  # no picture yet
    LIVE = "live"
    LOST = "lost"  # had pictures, sends none now
    ENDED = "ended"  # a file that has been played


@dataclass(frozen=True, slots=True)
class CameraHealth:
    """Condition of a camera, the time at which it began (on our clock [s]), and the reason."""

    condition: CameraCondition
    since: float
    why: str = ""
    losses: int = 0  # number of times that it was lost
    failed: bool = False  # an attempt to open it has failed


class Camera(ABC):
    """One camera. None of its methods waits for the device."""

    key: str
    kind: str
    shown: str

    @abstractmethod
    def start(self) -> None:
        """Start reading. Safe to call twice."""

    @abstractmethod
    def latest(self) -> CapturedImage | None:
        """Return the newest picture, the same one until there is a newer one; None before the first."""

    @abstractmethod
    def health(self) -> CameraHealth:
        """Return the present health of the camera."""

    @abstractmethod
    def request_stop(self) -> None:
        """Request the end of reading, without waiting for it."""

    @abstractmethod
    def close(self) -> None:
        """Stop reading and wait briefly for the end. Safe to call twice."""

    def begin_run(self) -> None:  # noqa: B027  # not abstract: a live camera needs nothing
        """Start a run; a camera that plays a file starts from its first picture."""

    def end_run(self) -> None:  # noqa: B027
        """End the run; a camera that plays a file returns to its first picture."""

    def faults(self) -> dict[str, int]:
        """Return the count of each fault since the start."""
        return {}


NOT_LIVE = Pattern("cameras.not_live", "camera {camera} ({source}) is {condition}: {why}")


def describe_camera_problems(
    cameras: Mapping[str, Mapping[str, Any]], keys: Iterable[str] | None = None
) -> list[str]:
    """Return a sentence (camera, source, condition, reason) for each camera that is not live.

    Only the cameras in `keys` are described if `keys` is given.
    """
    chosen = cameras if keys is None else [key for key in keys if key in cameras]
    return [
        NOT_LIVE(camera=key, source=health["source"], condition=health["condition"], why=health["why"])
        for key in chosen
        if (health := cameras[key])["condition"] != CameraCondition.LIVE
    ]
