"""ROS 1's bytes of the few messages that a robot speaks: little-endian, one field right behind the other.

Source: genmsg's message definitions as genpy writes them. Strings and sequences carry their length, and nothing is
aligned or terminated. A header begins with a number that the publisher counts up, which is no business of ours.
"""

from __future__ import annotations

import struct

from runtime.core.errors import CodecError
from runtime.transports.ros import fields
from runtime.transports.ros.fields import SECOND
from runtime.transports.ros.messages import Message, MessageName


class Reader(fields.Reader):
    """Reads ROS 1's serialization."""

    SHORTEST_TEXT = 4  # a length

    def __init__(self, payload: bytes) -> None:
        super().__init__(payload, "<", 0)

    def _gap(self, alignment: int) -> int:
        return 0

    def _text(self, raw: bytes, start: int) -> bytes:
        return raw

    def header(self) -> tuple[int, str]:
        """The publisher's count, seconds and nanoseconds, the frame."""
        self.u32()
        return self.stamp(self.u32(), self.u32()), self.string()

    def end(self) -> None:
        """CodecError unless all has been read: nothing pads a message here."""
        left = len(self._payload) - self._at
        if left:
            raise CodecError(f"a message of {len(self._payload)} bytes has {left} behind its last field")


class Writer(fields.Writer):
    """Writes ROS 1's serialization."""

    def _align(self, alignment: int) -> None:
        """Nothing is aligned."""

    def string(self, text: str) -> None:
        self._counted(text.encode("utf-8"))

    def header(self, stamp: int, frame: str) -> None:
        """A count of 0, which whoever publishes replaces by its own, seconds and nanoseconds, the frame."""
        self._out += struct.pack("<III", 0, *divmod(stamp, SECOND))
        self.string(frame)


def decode(name: MessageName, payload: bytes) -> Message:
    """The message of that type; CodecError where the bytes are none, or more than one."""
    given = Reader(payload)
    message = fields.read(name, given)
    given.end()
    return message


def encode(message: Message) -> bytes:
    """The bytes of a message; struct.error where a number does not fit."""
    return fields.write(message, Writer())
