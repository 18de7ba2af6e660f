"""Fields of the messages used with robots, in the order that ROS 1 and ROS 2 share.

The subclasses define the encoding of numbers and strings: `cdr` for ROS 2, `ros1_serialization` for ROS 1.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np

from runtime.core.errors import CodecError
from runtime.core.types import Float64, UInt8
from runtime.transports.ros.messages import (
    CompressedImage,
    Image,
    JointState,
    Message,
    MessageName,
    PoseStamped,
)

SECOND = 1_000_000_000


class Reader(ABC):
    """Decoder of one message from front to back. Raises CodecError if the bytes do not fit the message."""

    SHORTEST_TEXT: int  # [bytes] of an empty string

    def __init__(self, payload: bytes, order: str, start: int) -> None:
        self._payload, self._order, self._at = payload, order, start

    @abstractmethod
    def _gap(self, alignment: int) -> int:
        """Return the number of bytes to skip before a value with this alignment."""

    @abstractmethod
    def _text(self, raw: bytes, start: int) -> bytes:
        """Return the string in `raw`, which starts at `start`, without its terminator."""

    @abstractmethod
    def header(self) -> tuple[int, str]:
        """Decode std_msgs/Header: the stamp [ns] and the frame."""

    def advance(self, size: int, alignment: int) -> int:
        """Skip `size` bytes after the gap that `alignment` needs, and return the offset of the first of them."""
        start = self._at + self._gap(alignment)
        if size > len(self._payload) - start:
            raise CodecError(
                f"a message of {len(self._payload)} bytes ends within {size} bytes that begin at {start}"
            )
        self._at = start + size
        return start

    def _number(self, code: str, size: int) -> int:
        value: int = struct.unpack_from(self._order + code, self._payload, self.advance(size, size))[0]
        return value

    def u8(self) -> int:
        return self._payload[self.advance(1, 1)]

    def u32(self) -> int:
        return self._number("I", 4)

    def i32(self) -> int:
        return self._number("i", 4)

    def string(self) -> str:
        size = self.u32()
        start = self.advance(size, 1)
        raw = self._text(self._payload[start : start + size], start)
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError as error:
            raise CodecError(f"a string at {start} is not UTF-8: {error}") from error

    def strings(self) -> tuple[str, ...]:
        count = self.u32()
        if count > (len(self._payload) - self._at) // self.SHORTEST_TEXT:
            raise CodecError(f"a message of {len(self._payload)} bytes announces {count} strings")
        return tuple(self.string() for _ in range(count))

    def doubles(self, count: int | None = None) -> Float64:
        """Decode a sequence of float64; with `count`, an array of that fixed length, which has no length prefix."""
        count = self.u32() if count is None else count
        if count == 0:  # an empty sequence is not aligned
            return np.zeros(0)
        start = self.advance(8 * count, 8)
        return np.frombuffer(self._payload, self._order + "f8", count, start).astype(np.float64)

    def octets(self) -> UInt8:
        """Decode a sequence of uint8; the result is a view into the message."""
        count = self.u32()
        return np.frombuffer(self._payload, np.uint8, count, self.advance(count, 1))

    def stamp(self, seconds: int, nanoseconds: int) -> int:
        """Return ROS time [ns] from its two fields. Raises CodecError for a second or more in `nanoseconds`."""
        if nanoseconds >= SECOND:
            raise CodecError(f"a stamp has {nanoseconds} nanoseconds; expected less than a second")
        return seconds * SECOND + nanoseconds


class Writer(ABC):
    """Encoder of one message, little-endian."""

    def __init__(self, begin: bytes = b"") -> None:
        self._out = bytearray(begin)

    @abstractmethod
    def _align(self, alignment: int) -> None:
        """Write padding up to the given alignment."""

    @abstractmethod
    def header(self, stamp: int, frame: str) -> None:
        """Encode std_msgs/Header with a stamp [ns]."""

    @abstractmethod
    def string(self, text: str) -> None: ...

    def u8(self, value: int) -> None:
        self._out.append(value)

    def u32(self, value: int) -> None:
        self._align(4)
        self._out += struct.pack("<I", value)

    def _counted(self, raw: bytes) -> None:
        self.u32(len(raw))
        self._out += raw

    def strings(self, texts: tuple[str, ...]) -> None:
        self.u32(len(texts))
        for text in texts:
            self.string(text)

    def doubles(self, values: Float64, fixed: bool = False) -> None:
        if not fixed:
            self.u32(len(values))
        if len(values):
            self._align(8)
            self._out += np.ascontiguousarray(values, "<f8").tobytes()

    def octets(self, values: UInt8) -> None:
        self.u32(len(values))
        self._out += np.ascontiguousarray(values, np.uint8).data

    def done(self) -> bytes:
        return bytes(self._out)


def read(name: MessageName, given: Reader) -> Message:
    """Decode a message of the given type."""
    return _READ[name](given)


def write(message: Message, out: Writer) -> bytes:
    """Encode a message. Raises struct.error if a number is out of range."""
    out.header(message.stamp, message.frame)
    if isinstance(message, JointState):
        out.strings(message.names)
        for numbers in (message.position, message.velocity, message.effort):
            out.doubles(numbers)
    elif isinstance(message, Image):
        out.u32(message.height)
        out.u32(message.width)
        out.string(message.encoding)
        out.u8(0)  # is_bigendian
        out.u32(message.step)
        out.octets(message.data)
    elif isinstance(message, CompressedImage):
        out.string(message.format)
        out.octets(message.data)
    else:
        out.doubles(message.pose, fixed=True)
    return out.done()


def _joint_state(reader: Reader) -> JointState:
    stamp, frame = reader.header()
    return JointState(stamp, frame, reader.strings(), reader.doubles(), reader.doubles(), reader.doubles())


def _image(reader: Reader) -> Image:
    stamp, frame = reader.header()
    height, width, encoding = reader.u32(), reader.u32(), reader.string()
    reader.u8()  # is_bigendian has no meaning for bytes
    return Image(stamp, frame, height, width, encoding, reader.u32(), reader.octets())


def _compressed(reader: Reader) -> CompressedImage:
    stamp, frame = reader.header()
    return CompressedImage(stamp, frame, reader.string(), reader.octets())


def _pose(reader: Reader) -> PoseStamped:
    stamp, frame = reader.header()
    return PoseStamped(stamp, frame, reader.doubles(7))


_READ: dict[MessageName, Callable[[Reader], Message]] = {
    "JointState": _joint_state,
    "Image": _image,
    "CompressedImage": _compressed,
    "PoseStamped": _pose,
}
