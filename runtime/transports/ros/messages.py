"""ROS messages of arms and cameras, independent of the middleware."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, Protocol, TypeAlias

import numpy as np

from runtime.core.types import Float64, UInt8

MessageName = Literal["JointState", "Image", "CompressedImage", "PoseStamped"]


def _none() -> Float64:
    return np.zeros(0)


@dataclass(frozen=True, slots=True, eq=False)
class JointState:
    """sensor_msgs/JointState: values by joint, `stamp` in ROS time [ns]; velocity and effort may be empty."""

    stamp: int
    frame: str
    names: tuple[str, ...]
    position: Float64
    velocity: Float64 = field(default_factory=_none)
    effort: Float64 = field(default_factory=_none)


@dataclass(frozen=True, slots=True, eq=False)
class Image:
    """sensor_msgs/Image: `data` uint8 [N], rows of `step` bytes, in `encoding`."""

    stamp: int
    frame: str
    height: int
    width: int
    encoding: str
    step: int
    data: UInt8


@dataclass(frozen=True, slots=True, eq=False)
class CompressedImage:
    """sensor_msgs/CompressedImage: an encoded picture of `format`, e.g. "jpeg" or "bgr8; png compressed bgr8"."""

    stamp: int
    frame: str
    format: str
    data: UInt8


@dataclass(frozen=True, slots=True, eq=False)
class PoseStamped:
    """geometry_msgs/PoseStamped: `pose` float64 [7] as transmitted: x, y, z [m], quaternion x, y, z, w."""

    stamp: int
    frame: str
    pose: Float64


Message: TypeAlias = JointState | Image | CompressedImage | PoseStamped
PACKAGES: dict[MessageName, str] = {
    "JointState": "sensor_msgs",
    "Image": "sensor_msgs",
    "CompressedImage": "sensor_msgs",
    "PoseStamped": "geometry_msgs",
}


class Wire(Protocol):
    """Codec of the messages of ROS 1 or ROS 2: the functions of a codec module.

    `decode` raises CodecError. Arrays of bytes in its result are views into `payload`.
    """

    def decode(self, name: MessageName, payload: bytes) -> Message: ...

    def encode(self, message: Message) -> bytes: ...
