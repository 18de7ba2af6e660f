"""Msgpack dialects of GR00T: arrays as numpy files (NPY), or in the form of the package msgpack_numpy (MNP).

NPY, used by N1.5 and N1.6: a map of `__ndarray_class__` true and `as_npy`, the bytes of a .npy file. MNP, used by N1.7:
a map of `nd`, `type`, `kind`, `shape`, `data` with binary keys. N1.7 reads both, its early access only MNP, which is
XPolicyLab's form, too. Nothing is ever unpickled here.
"""

from __future__ import annotations

import io
import math
import re
import struct
from collections.abc import Mapping
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np

from runtime.core.errors import CodecError

_KINDS = "biuf"  # bool, integers, floats
_MAGIC = b"\x93NUMPY"
_HEADER = re.compile(
    r"\{'descr': '([^']*)', 'fortran_order': (True|False), 'shape': \(((?:\d+,? ?)*)\),? ?\}\s*"
)
_MOST_DIMENSIONS = 32


def pack(value: object, mnp: bool = False) -> bytes:
    """Return `value` as one message: arrays as MNP if `mnp`, else as NPY; numpy scalars as numbers.

    Raises CodecError for other types.
    """
    try:
        packed: bytes = msgpack.packb(value, default=_as_mnp if mnp else _as_npy)
    except (TypeError, ValueError, OverflowError) as error:
        raise CodecError(f"cannot pack {type(value).__name__}: {error}") from error
    return packed


def unpack(payload: bytes, limit: int) -> Any:
    """Return the value in one message; arrays of bools, integers and floats are **read-only**.

    Raises CodecError for more than `limit` bytes, invalid msgpack, an array whose data do not fill its shape, object
    arrays and other dtypes, and for arrays in openpi's form (which the message then names).
    """
    if len(payload) > limit:
        raise CodecError(f"a message of {len(payload)} bytes exceeds the limit of {limit}")
    try:
        return msgpack.unpackb(payload, object_hook=_decode)
    except CodecError:
        raise
    except (ValueError, TypeError, OverflowError, msgpack.exceptions.UnpackException) as error:
        text = str(error) or type(error).__name__
        raise CodecError(f"{len(payload)} bytes are not one msgpack message: {text}") from error


def _as_npy(value: object) -> object:
    if not isinstance(value, np.ndarray):
        return _number(value)
    file = io.BytesIO()
    np.save(file, _plain(value), allow_pickle=False)
    return {"__ndarray_class__": True, "as_npy": file.getvalue()}


def _as_mnp(value: object) -> object:
    if not isinstance(value, np.ndarray):
        return _number(value)
    fields = {b"nd": True, b"type": _plain(value).dtype.str, b"kind": b"", b"shape": list(value.shape)}
    return fields | {b"data": value.tobytes()}


def _plain(array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    if array.dtype.kind not in _KINDS:
        raise CodecError(f"cannot pack an array of {array.dtype.str!r}; allowed: bool, integers, floats")
    return array


def _number(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()  # N1.6 cannot pack numpy scalars
    raise CodecError(f"cannot pack a {type(value).__name__}; allowed: numbers, strings, lists, maps, arrays")


def _decode(fields: dict[Any, Any]) -> object:
    if "__ndarray_class__" in fields:
        return _from_npy(fields.get("as_npy"))
    if b"nd" in fields or "nd" in fields:
        return _from_mnp({_text(key): value for key, value in fields.items()})
    if b"complex" in fields:
        raise CodecError("found a complex number; allowed: bool, integers, floats")
    if any(mark in fields for mark in (b"__ndarray__", "__ndarray__", b"__npgeneric__")):
        raise CodecError(
            "found an array in the openpi dialect ('__ndarray__'); expected NPY ('__ndarray_class__') or MNP ('nd'): "
            "the peer speaks another protocol than the one configured"
        )
    return fields


def _text(key: object) -> object:
    return key.decode("ascii", "replace") if isinstance(key, bytes) else key


def _from_npy(data: object) -> np.ndarray[Any, Any]:
    """Return the array of a .npy file.

    Its header is parsed here, because numpy would allocate whatever size the header states.
    """
    if not isinstance(data, bytes) or data[:6] != _MAGIC:
        raise CodecError(f"an array's as_npy is {_short(data)}; expected the bytes of a .npy file")
    start, length = {1: (10, "<H"), 2: (12, "<I")}.get(data[6] if len(data) > 6 else 0, (0, ""))
    if not start or len(data) < start:
        raise CodecError(f"a .npy file begins with {data[:12]!r}; allowed: version 1 or 2 of the format")
    end = start + struct.unpack_from(length, data, 8)[0]
    match = _HEADER.fullmatch(data[start:end].decode("latin-1"))
    if match is None:
        raise CodecError(
            f"a .npy file has the header {data[start:end][:80]!r}; expected one array of a plain type"
        )
    descr, fortran, numbers = match.groups()
    shape = [int(number) for number in numbers.replace(",", " ").split()]
    return _array(descr, shape, data[end:], "F" if fortran == "True" else "C")


def _from_mnp(fields: Mapping[object, Any]) -> object:
    kind, name, data = fields.get("kind", b""), _text(fields.get("type")), fields.get("data")
    if kind not in (b"", ""):
        raise CodecError(
            f"an array of kind {kind!r} is refused (O: Python objects, V: structures); allowed: bool, integers, floats"
        )
    if not isinstance(data, bytes):
        raise CodecError(f"an array's data are {type(data).__name__}; expected bytes")
    if fields.get("nd") is False:
        return _array(name, [], data, "C")[()]
    shape = fields.get("shape")
    if not isinstance(shape, list) or any(type(number) is not int or number < 0 for number in shape):
        raise CodecError(f"an array has the shape {_short(shape)}; expected a list of integers from 0 on")
    return _array(name, shape, data, "C")


def _array(name: object, shape: list[int], data: bytes, order: Any) -> np.ndarray[Any, Any]:
    """Return an array over `data`. Raises CodecError if the data do not fill it, or its dtype is refused."""
    if not isinstance(name, str) or not re.fullmatch(r"[<>|=]?[a-zA-Z?]\d*", name):
        raise CodecError(
            f"an array's dtype is {_short(name)}; allowed: bool, integers, floats, such as '<f4'"
        )
    try:
        dtype = np.dtype(name)
    except (TypeError, ValueError) as error:
        raise CodecError(f"an array's dtype is {name!r}, which numpy does not know") from error
    if dtype.kind not in _KINDS:
        raise CodecError(f"arrays of {name!r} are refused (objects, structures, text); allowed: {_KINDS}")
    if len(shape) > _MOST_DIMENSIONS or math.prod(shape) * dtype.itemsize != len(data):
        raise CodecError(
            f"an array of {name} {shape[:_MOST_DIMENSIONS]} does not fit {len(data)} bytes of data"
        )
    try:
        return np.frombuffer(data, dtype).reshape(shape, order=order) if data else np.zeros(shape, dtype)
    except (ValueError, TypeError, OverflowError) as error:
        raise CodecError(f"an array of {name} {shape} is impossible: {error}") from error


def _short(value: object) -> str:
    return f"{type(value).__name__} {str(value)[:60]!r}"
