"""Codec of arrays in openpi's format for stand-ins; it shares no code with the client's codec, so that it can test
that.
"""

from __future__ import annotations

import math
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np


def packed(value: object) -> bytes:
    """Pack a value as one message; an array becomes a map with four binary keys."""
    payload: bytes = msgpack.packb(value, default=_written)
    return payload


def unpacked(payload: bytes) -> Any:
    """Unpack one message.

    Raises:
        ValueError: If it is malformed, or contains an array of objects or of another size than it declares.
        KeyError, TypeError: If an array lacks a field or has an unknown type.
    """
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
