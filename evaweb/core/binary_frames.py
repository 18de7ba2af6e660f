"""Binary message that carries numbers and images to a page: a JSON header, then the raw values.

Layout: length of the header (uint32), header (UTF-8 JSON), and from the next multiple of 8 the body, in which every
value starts at a multiple of 8. All numbers are little-endian. An `offset` in the header counts bytes from the start of
the body. A page reads values in place: `new Float32Array(buffer, body + offset, n)`.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaweb.core.errors import EvaError

_ALIGNMENT = 8
_LENGTH = struct.Struct("<I")
DTYPES = ("f4", "f8", "i4", "u1")  # types with a typed array in browsers


class FrameError(EvaError):
    """Error if a message violates the layout, or a value cannot be encoded in it."""


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """One entry of the header's `streams`.

    `json` holds small values and `arrays` named arrays; `body` is the stream itself if it is one array or one file, and
    `facts` (mime, age, ...) are stored next to its offset.
    """

    json: Mapping[str, Any] | None = None
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    body: NDArray[Any] | bytes | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)


def encode(streams: Mapping[str, Stream], **header: Any) -> bytes:
    """Return the message with these streams; `header` are further keys of the header, such as frame and t.

    Non-finite numbers become null in the header and are unchanged in arrays.
    Raises: FrameError if an array has a type that a browser cannot read in place.
    """
    body = _Body()
    entries = {name: _entry(name, stream, body) for name, stream in streams.items()}
    text = json.dumps(
        to_json_value({**header, "streams": entries}), separators=(",", ":"), allow_nan=False
    ).encode()
    start = _LENGTH.size + len(text)
    return b"".join([_LENGTH.pack(len(text)), text, bytes(-start % _ALIGNMENT), *body.pieces])


def _entry(name: str, stream: Stream, body: _Body) -> dict[str, Any]:
    entry = dict(stream.facts)
    if isinstance(stream.body, bytes):
        entry |= {"offset": body.add(stream.body), "length": len(stream.body)}
    elif stream.body is not None:
        entry |= _array(name, stream.body, body)
    if stream.json is not None:
        entry["json"] = stream.json
    if stream.arrays:
        entry["arrays"] = {key: _array(f"{name}.{key}", value, body) for key, value in stream.arrays.items()}
    return entry


def _array(name: str, value: NDArray[Any], body: _Body) -> dict[str, Any]:
    dtype = value.dtype.newbyteorder("<").str[1:]
    if dtype not in DTYPES:
        raise FrameError(f"{name} is an array of {value.dtype}; allowed: {', '.join(DTYPES)}")
    ordered = np.ascontiguousarray(value, dtype=value.dtype.newbyteorder("<"))
    return {"offset": body.add(ordered.tobytes()), "dtype": dtype, "shape": list(value.shape)}


class _Body:
    """Concatenated values, each padded to a multiple of 8 bytes."""

    def __init__(self) -> None:
        self.pieces: list[bytes] = []
        self._size = 0

    def add(self, data: bytes) -> int:
        offset = self._size
        gap = bytes(-len(data) % _ALIGNMENT)
        self.pieces += [data, gap]
        self._size += len(data) + len(gap)
        return offset


def to_json_value(value: Any) -> Any:
    """Return `value` as JSON-compatible objects; non-finite numbers become None."""
    if isinstance(value, Mapping):
        return {str(key): to_json_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json_value(item) for item in value]
    if isinstance(value, np.generic | np.ndarray):
        return to_json_value(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A decoded message: its header, and the bytes that the offsets refer to."""

    header: Mapping[str, Any]
    body: memoryview

    def array(self, name: str, key: str | None = None) -> NDArray[Any]:
        """Return the array of stream `name`, or its named array `key`; read-only."""
        entry = self.header["streams"][name]
        where = entry if key is None else entry["arrays"][key]
        shape = tuple(where["shape"])
        values = np.frombuffer(self.body, "<" + where["dtype"], math.prod(shape), where["offset"])
        return values.reshape(shape)

    def data(self, name: str) -> bytes:
        """Return the bytes of the file in stream `name`."""
        entry = self.header["streams"][name]
        return bytes(self.body[entry["offset"] : entry["offset"] + entry["length"]])


def decode(message: bytes) -> Frame:
    """Decode a message, for clients in Python. Raises: FrameError if it is truncated or malformed."""
    if len(message) < _LENGTH.size:
        raise FrameError(
            f"a message of {len(message)} bytes has no header; at least {_LENGTH.size} are wanted"
        )
    end = _LENGTH.size + _LENGTH.unpack_from(message)[0]
    if end > len(message):
        raise FrameError(f"the header says it ends at byte {end}, the message has {len(message)}")
    try:
        header = json.loads(message[_LENGTH.size : end])
    except ValueError as error:
        raise FrameError(f"the header is no JSON: {error}") from None
    if not isinstance(header, dict) or not isinstance(header.get("streams"), dict):
        raise FrameError("the header has no streams")
    return Frame(header, memoryview(message)[end + -end % _ALIGNMENT :])
