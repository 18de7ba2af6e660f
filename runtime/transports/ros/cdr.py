"""ROS 2's bytes of the few messages that a robot speaks: CDR, the first version (XCDR1), plain.

Source: OMG DDS-RTPS 2.5, section 10 (four bytes of header, alignment counted from behind it); rosidl's message
definitions. Strings carry their terminating zero, sequences their length.
"""

from __future__ import annotations

import struct

from runtime.core.errors import CodecError
from runtime.transports.ros import fields
from runtime.transports.ros.fields import SECOND
from runtime.transports.ros.messages import Message, MessageName

_LITTLE, _BIG = b"\x00\x01", b"\x00\x00"
_HEADER = 4


class Reader(fields.Reader):
    """Reads plain CDR of either byte order."""

    SHORTEST_TEXT = 5  # a length and a zero byte

    def __init__(self, payload: bytes) -> None:
        kind = payload[:2]
        if len(payload) < _HEADER or kind not in (_LITTLE, _BIG):
            raise CodecError(
                f"a message begins with {payload[:_HEADER].hex() or 'nothing'}; expected plain CDR, "
                "0001 (little-endian) or 0000 (big-endian)"
            )
        super().__init__(payload, "<" if kind == _LITTLE else ">", _HEADER)

    def _gap(self, alignment: int) -> int:
        return -(self._at - _HEADER) % alignment

    def _text(self, raw: bytes, start: int) -> bytes:
        if not raw.endswith(b"\0"):
            raise CodecError(f"a string of {len(raw)} bytes at {start} does not end with a zero byte")
        return raw[:-1]

    def header(self) -> tuple[int, str]:
        """Seconds and nanoseconds, the frame."""
        return self.stamp(self.i32(), self.u32()), self.string()


class Writer(fields.Writer):
    """Writes plain CDR, little-endian."""

    def __init__(self) -> None:
        super().__init__(_LITTLE + b"\0\0")

    def _align(self, alignment: int) -> None:
        self._out += bytes(-(len(self._out) - _HEADER) % alignment)

    def string(self, text: str) -> None:
        self._counted(text.encode("utf-8") + b"\0")

    def header(self, stamp: int, frame: str) -> None:
        """Seconds and nanoseconds, the frame."""
        self._align(4)
        self._out += struct.pack("<iI", *divmod(stamp, SECOND))
        self.string(frame)


def decode(name: MessageName, payload: bytes) -> Message:
    """The message of that type; CodecError where the bytes are none. Bytes behind it (padding) do not matter."""
    return fields.read(name, Reader(payload))


def encode(message: Message) -> bytes:
    """The bytes of a message; struct.error where a number does not fit."""
    return fields.write(message, Writer())
