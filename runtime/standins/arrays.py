"""Arrays on the wire as openpi's own package writes them: the stand-ins' half, written apart from the clients'."""

from __future__ import annotations

import math
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np


def packed(value: object) -> bytes:
    """One message; arrays as a map of four binary keys."""
    made: bytes = msgpack.packb(value, default=_written)
    return made


def unpacked(payload: bytes) -> Any:
    """The value of one message; ValueError where it is none."""
    return msgpack.unpackb(payload, object_hook=_read)


def _written(value: object) -> dict[bytes, object]:
    if isinstance(value, np.ndarray):
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": list(value.shape),
        }
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"cannot pack a {type(value).__name__}")


def _read(fields: dict[Any, Any]) -> Any:
    if b"__ndarray__" in fields:
        dtype, shape = np.dtype(fields[b"dtype"]), fields[b"shape"]
        if dtype.hasobject or len(fields[b"data"]) != dtype.itemsize * math.prod(shape):
            raise ValueError(f"an array of {dtype.str} {shape} has {len(fields[b'data'])} bytes")
        return np.frombuffer(fields[b"data"], dtype).reshape(shape)
    if b"__npgeneric__" in fields:
        return np.dtype(fields[b"dtype"]).type(fields[b"data"])
    return fields
