"""ROS 1 encoding of the messages used with robots: little-endian, fields without gaps.

Source: genmsg's message definitions as genpy writes them. Strings and sequences start with their length; nothing is
aligned or terminated. A header begins with a number that the publisher counts up and that is not used here.
"""

from __future__ import annotations

import struct

from runtime.core.errors import CodecError
from runtime.transports.ros import fields
from runtime.transports.ros.fields import SECOND
from runtime.transports.ros.messages import Message, MessageName


class Reader(fields.Reader):
    """Decoder of ROS 1's serialization."""

    SHORTEST_TEXT = 4  # [bytes]; the length

    def __init__(self, payload: bytes) -> None:
        super().__init__(payload, "<", 0)

    def _gap(self, alignment: int) -> int:
        return 0

    def _text(self, raw: bytes, start: int) -> bytes:
        return raw

    def header(self) -> tuple[int, str]:
        """Decode a header without the publisher's count: return the stamp [ns] and the frame."""
        self.u32()
        return self.stamp(self.u32(), self.u32()), self.string()

    def end(self) -> None:
        """Raise CodecError unless all bytes have been read: ROS 1 has no padding."""
        left = len(self._payload) - self._at
        if left:
            raise CodecError(f"a message of {len(self._payload)} bytes has {left} behind its last field")


class Writer(fields.Writer):
    """Encoder of ROS 1's serialization."""

    def _align(self, alignment: int) -> None:
        """Do nothing: ROS 1 has no alignment."""

    def string(self, text: str) -> None:
        self._counted(text.encode("utf-8"))

    def header(self, stamp: int, frame: str) -> None:
        """Write a header, which consists of a count, the stamp [ns] and the frame.

        The count is written as 0, because the publisher replaces it by its own count.
        """
        self._out += struct.pack("<III", 0, *divmod(stamp, SECOND))
        self.string(frame)


def decode(name: MessageName, payload: bytes) -> Message:
    """Decode a message of the given type. Raises CodecError for invalid or surplus bytes."""
    reader = Reader(payload)
    message = fields.read(name, reader)
    reader.end()
    return message


def encode(message: Message) -> bytes:
    """Encode a message. Raises struct.error if a number is out of range."""
    return fields.write(message, Writer())
