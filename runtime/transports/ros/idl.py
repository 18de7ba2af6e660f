"""The four message types under ROS 2's names, as cyclonedds needs them; their bytes are encoded elsewhere.

cyclonedds needs classes to announce the type of a topic, and would encode and decode them byte by byte in Python (62 ms
per picture). Their codec is therefore replaced: an object holds the bytes of one message. The module must not be
imported without the package cyclonedds, nor begin with `from __future__ import annotations`, which cyclonedds cannot
resolve.
"""
# mypy: disable-error-code="type-arg, misc, call-arg, untyped-decorator"

from dataclasses import dataclass
from typing import Any

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import float64, int32, sequence, uint8, uint32

from runtime.transports.ros.messages import MessageName


@dataclass
@final
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
@final
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
@final
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


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


@dataclass
@final
class CompressedImage(IdlStruct, typename="sensor_msgs::msg::dds_::CompressedImage_"):
    header: Header
    format: str
    data: sequence[uint8]


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


def _opaque(kind: Any) -> Any:
    """Return the class with its codec replaced, so that its objects hold a message's bytes as `payload`.

    The class itself is changed, because DDS would not accept a subclass.
    """

    def hold(self: Any, payload: bytes) -> None:
        self.payload = payload

    kind.__init__ = hold
    kind.serialize = lambda self, *_, **__: self.payload
    kind.deserialize = classmethod(lambda made, data, *_, **__: made(data))
    return kind


TYPES: dict[MessageName, Any] = {
    "JointState": _opaque(JointState),
    "Image": _opaque(Image),
    "CompressedImage": _opaque(CompressedImage),
    "PoseStamped": _opaque(PoseStamped),
}
# Type hashes of REP 2011, the same from Humble to Jazzy. Peers match without them, but rmw_cyclonedds warns.
HASHES: dict[MessageName, str] = {
    "JointState": "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "Image": "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
    "CompressedImage": "RIHS01_15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
    "PoseStamped": "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
}
