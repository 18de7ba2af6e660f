"""ROS 2 encoding of the messages used with robots: plain CDR version 1 (XCDR1).

Source: OMG DDS-RTPS 2.5, section 10 (header of four bytes, alignment counted from its end), and the message
definitions of rosidl. Strings include their terminating zero; sequences start with their length.
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
    """Decoder of plain CDR in either byte order."""

    SHORTEST_TEXT = 5  # [bytes]; length and zero byte

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
        """Decode a header: return the stamp [ns] and the frame."""
        return self.stamp(self.i32(), self.u32()), self.string()


class Writer(fields.Writer):
    """Encoder of plain CDR, little-endian."""

    def __init__(self) -> None:
        super().__init__(_LITTLE + b"\0\0")

    def _align(self, alignment: int) -> None:
        self._out += bytes(-(len(self._out) - _HEADER) % alignment)

    def string(self, text: str) -> None:
        self._counted(text.encode("utf-8") + b"\0")

    def header(self, stamp: int, frame: str) -> None:
        """Write the stamp [ns], as seconds and nanoseconds, and the frame."""
        self._align(4)
        self._out += struct.pack("<iI", *divmod(stamp, SECOND))
        self.string(frame)


def decode(name: MessageName, payload: bytes) -> Message:
    """Decode a message of the given type; trailing bytes (padding) are ignored. Raises CodecError for invalid bytes."""
    return fields.read(name, Reader(payload))


def encode(message: Message) -> bytes:
    """Encode a message. Raises struct.error if a number is out of range."""
    return fields.write(message, Writer())
