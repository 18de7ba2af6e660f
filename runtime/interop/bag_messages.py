"""Contents of ROS messages that an import understands: numbers of joints, and pictures."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from runtime.core.errors import RecordingError
from runtime.core.types import Float64, UInt8

FIELDS = ("position", "velocity", "effort")


@dataclass(frozen=True, slots=True, eq=False)
class Numbers:
    """Named numbers of one message; `values` has those of FIELDS that the message gives for all names."""

    names: tuple[str, ...]
    values: Mapping[str, Float64]


def _joint_state(message: Any) -> Numbers:
    names = tuple(message.name)
    given = {field: np.asarray(getattr(message, field), np.float64) for field in FIELDS}
    return Numbers(names, {field: values for field, values in given.items() if len(values) == len(names)})


def _trajectory(message: Any) -> Numbers:
    """Return the first point, which is due first; a trajectory without points has no numbers."""
    if not len(message.points):
        return Numbers((), {})
    point, names = message.points[0], tuple(message.joint_names)
    values = np.asarray(point.positions, np.float64)
    return Numbers(names, {"position": values} if len(values) == len(names) else {})


def _array(message: Any) -> Numbers:
    values = np.asarray(message.data, np.float64).reshape(-1)
    return Numbers(tuple(map(str, range(len(values)))), {"position": values})


NUMBERS: Mapping[str, Callable[[Any], Numbers]] = {
    "sensor_msgs/msg/JointState": _joint_state,
    "trajectory_msgs/msg/JointTrajectory": _trajectory,
    "std_msgs/msg/Float64MultiArray": _array,
    "std_msgs/msg/Float32MultiArray": _array,
    "std_msgs/msg/Float64": _array,
    "std_msgs/msg/Float32": _array,
}
"""Readers of numbers by type of message; arrays have their indices as names."""

PICTURES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "foxglove_msgs/msg/CompressedVideo")
TEXT = "std_msgs/msg/String"

_CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1}
_VIDEOS = {"h264": "h264", "h265": "hevc", "hevc": "hevc", "av1": "libdav1d", "vp9": "vp9"}


class PictureDecoder:
    """Decoder of the pictures of one topic, message by message, to RGB uint8 [H, W, 3].

    A video decoder may return a picture some messages late; the pictures are in the order of the messages.
    """

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self._coder: Any = None
        self._waiting: deque[int] = deque()  # numbers of messages whose picture is not decoded yet

    def add(self, number: int, kind: str, message: Any, wanted: bool) -> Iterator[tuple[int, UInt8]]:
        """Yield the pictures that message `number` completes, each with the number of its own message.

        A picture that is not `wanted` need not be decoded if no other depends on it.

        Raises:
            RecordingError: The message contains no picture that is understood.
        """
        if kind == "sensor_msgs/msg/Image":
            if wanted:
                yield number, self._plain(message)
            return
        form = str(message.format).lower()
        if video := next((coder for name, coder in _VIDEOS.items() if name in form), None):
            yield from self._video(number, video, bytes(message.data))
        elif wanted:
            yield number, self._still(form, bytes(message.data))

    def flush(self) -> Iterator[tuple[int, UInt8]]:
        """Yield the pictures that a video decoder still holds."""
        if self._coder is not None:
            yield from self._decoded(None)

    def _plain(self, message: Any) -> UInt8:
        encoding = str(message.encoding)
        if encoding not in _CHANNELS:
            raise self._error(f"encoding {encoding!r}; allowed: {', '.join(_CHANNELS)}")
        channels, height, width, step = (
            _CHANNELS[encoding],
            int(message.height),
            int(message.width),
            int(message.step),
        )
        data = np.asarray(message.data, np.uint8)
        if step < width * channels or len(data) < height * step or not height * width:
            raise self._error(
                f"{len(data)} bytes for {width} x {height} pixels of {encoding} with step {step}"
            )
        rows = data[: height * step].reshape(height, step)[:, : width * channels]
        picture = rows.reshape(height, width, channels)[..., :3]
        if encoding.startswith("bgr"):
            picture = picture[..., ::-1]
        return np.ascontiguousarray(np.broadcast_to(picture, (height, width, 3)))

    def _still(self, form: str, data: bytes) -> UInt8:
        import cv2  # no other kind of picture needs it

        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
        if picture is None:
            raise self._error(
                f"{len(data)} bytes of format {form!r} are no picture; allowed: jpeg, png, {', '.join(_VIDEOS)}"
            )
        return np.ascontiguousarray(picture[..., ::-1], np.uint8)

    def _video(self, number: int, coder: str, data: bytes) -> Iterator[tuple[int, UInt8]]:
        import av

        if self._coder is None:
            self._coder = av.CodecContext.create(coder, "r")
            self._coder.thread_count = 1  # threads would delay pictures
        self._waiting.append(number)
        yield from self._decoded(av.Packet(data))

    def _decoded(self, packet: Any) -> Iterator[tuple[int, UInt8]]:
        import av

        try:
            frames = self._coder.decode(packet)
        except av.FFmpegError as error:
            raise self._error(f"its video cannot be decoded: {error}") from error
        for frame in frames:
            if not self._waiting:
                raise self._error("its video has more pictures than messages")
            yield self._waiting.popleft(), frame.to_ndarray(format="rgb24")

    def _error(self, why: str) -> RecordingError:
        return RecordingError(f"{self._topic}: {why}")
