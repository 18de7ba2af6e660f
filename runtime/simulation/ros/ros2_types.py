"""Messages of the simulated ROS 2 robot, with a codec of their own: no code is shared with the transport under test.

Joints and poses use cyclonedds' codec. Images are serialised here, because cyclonedds takes 60 ms for each. The module
has no `from __future__ import annotations`, because cyclonedds cannot resolve the annotations that it would leave as
text.
"""
# mypy: disable-error-code="type-arg, misc, call-arg, untyped-decorator"

import struct
from dataclasses import dataclass, field
from typing import Any

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import float64, int32, sequence, uint8, uint32


@dataclass
@final
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
@final
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str = ""


@dataclass
@final
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64] = field(default_factory=list)
    effort: sequence[float64] = field(default_factory=list)


@dataclass
@final
class Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    x: float64
    y: float64
    z: float64


@dataclass
@final
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
@final
class Pose(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    position: Point
    orientation: Quaternion


@dataclass
@final
class PoseStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PoseStamped_"):
    header: Header
    pose: Pose


@dataclass
@final
class Image(IdlStruct, typename="sensor_msgs::msg::dds_::Image_"):
    header: Header
    height: uint32
    width: uint32
    encoding: str
    is_bigendian: uint8
    step: uint32
    data: sequence[uint8]

    def serialize(self, *_: Any, **__: Any) -> bytes:
        """Return the CDR bytes of the message; `data` must be bytes."""
        packed = _text(_fields(_header(self.header), "II", self.height, self.width), self.encoding)
        packed = _fields(packed + bytes([self.is_bigendian]), "II", self.step, len(self.data))
        return packed + bytes(self.data)


@dataclass
@final
class CompressedImage(IdlStruct, typename="sensor_msgs::msg::dds_::CompressedImage_"):
    header: Header
    format: str
    data: sequence[uint8]

    def serialize(self, *_: Any, **__: Any) -> bytes:
        """Return the CDR bytes of the message; `data` must be bytes."""
        packed = _fields(_text(_header(self.header), self.format), "I", len(self.data))
        return packed + bytes(self.data)


def _fields(packed: bytes, kinds: str, *numbers: int) -> bytes:
    """Return `packed`, followed by padding to a multiple of four bytes and by `numbers`, four bytes each.

    `kinds` has the format character of each number for `struct`. `packed` is the message without its header of four
    bytes.
    """
    return packed + bytes(-len(packed) % 4) + struct.pack(f"<{kinds}", *numbers)


def _text(packed: bytes, text: str) -> bytes:
    raw = text.encode() + b"\0"
    return _fields(packed, "I", len(raw)) + raw


def _header(header: Header) -> bytes:
    encapsulation = b"\0\1\0\0"
    stamp = struct.pack("<iI", header.stamp.sec, header.stamp.nanosec)
    return _text(encapsulation + stamp, header.frame_id)
