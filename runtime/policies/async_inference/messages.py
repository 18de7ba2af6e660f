"""Protobuf messages of LeRobot's service `transport.AsyncInference`, encoded by hand because they have only two fields.

Observation has `transfer_state` = 1 (varint) and `data` = 2 (bytes); Actions and PolicySetup have `data` = 1; Empty has
no bytes.
"""

from __future__ import annotations

from collections.abc import Iterator

from runtime.core.errors import CodecError

READY = "/transport.AsyncInference/Ready"
INSTRUCT = "/transport.AsyncInference/SendPolicyInstructions"
OBSERVE = "/transport.AsyncInference/SendObservations"
ACT = "/transport.AsyncInference/GetActions"

EMPTY = b""
CHUNK = 2 * 1024 * 1024  # [bytes] of data per message
_BEGIN, _MIDDLE, _END = 1, 2, 3
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_LONGEST_VARINT = 10  # [bytes]


def encode_observations(data: bytes, chunk: int = CHUNK) -> Iterator[bytes]:
    """Yield Observation messages that carry `data` in pieces of at most `chunk` bytes.

    The state of the last message is END, that of the first message BEGIN, that of the others MIDDLE. A single message
    is END.
    """
    starts = range(0, len(data), chunk)
    for start in starts:
        last = start == starts[-1]
        state = _END if last else _BEGIN if start == 0 else _MIDDLE
        yield bytes([1 << 3 | _VARINT, state]) + _field(2, data[start : start + chunk])


def encode_setup(data: bytes) -> bytes:
    """Return a PolicySetup message."""
    return _field(1, data)


def decode_actions(message: bytes) -> bytes:
    """Return the field `data` of an Actions message, b"" if it has none; other fields are skipped.

    Raises CodecError for invalid protobuf.
    """
    place, data = 0, b""
    while place < len(message):
        tag, place = _varint(message, place)
        number, kind = tag >> 3, tag & 7
        if kind == _BYTES:
            length, place = _varint(message, place)
            value, place = message[place : place + length], place + length
            data = value if number == 1 else data
        elif number == 1:
            raise CodecError(f"the field data of Actions has wire type {kind}; expected {_BYTES} (bytes)")
        elif kind == _VARINT:
            _, place = _varint(message, place)
        elif kind in (_FIXED64, _FIXED32):
            place += 8 if kind == _FIXED64 else 4
        else:
            raise CodecError(f"{len(message)} bytes are no protobuf message: wire type {kind}")
        if place > len(message):
            raise CodecError(f"a protobuf message ends after {len(message)} bytes, within a field")
    return data


def _field(number: int, data: bytes) -> bytes:
    length, coded = len(data), bytearray()
    while length > 0x7F:
        coded.append(length & 0x7F | 0x80)
        length >>= 7
    coded.append(length)
    return bytes([number << 3 | _BYTES]) + bytes(coded) + data


def _varint(message: bytes, place: int) -> tuple[int, int]:
    """Return the varint at byte `place` and the position after it."""
    number = 0
    for index, byte in enumerate(message[place : place + _LONGEST_VARINT]):
        number |= (byte & 0x7F) << 7 * index
        if byte < 0x80:
            return number, place + index + 1
    raise CodecError(f"a protobuf message of {len(message)} bytes has no whole number at byte {place}")
