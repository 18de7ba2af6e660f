"""Codec of arrays in msgpack, in the dialect of openpi and our execution nodes; independent of robots.

An array is a map with binary keys, in this order: `__ndarray__` true, `data` in C order, `dtype` (numpy's string),
`shape`. A numpy scalar is a map of `__npgeneric__` true, `data` the Python number, `dtype`. Two other dialects exist:
the package msgpack_numpy, and numpy's file format inside a map. A decoder of one of them returns arrays of another
dialect as plain maps without an error. The decoder of this module recognises the keys of both and raises an error.
Nothing is unpickled.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np

from runtime.core.errors import CodecError

DEFAULT_LIMIT = 256 * 1024 * 1024  # [bytes] of one message
_REFUSED_KINDS = frozenset("VOc")  # structures, Python objects, complex numbers
_BUFFERED_KINDS = frozenset("biuf")  # kinds whose memory msgpack reads without a copy
_SCALARS = (bool, int, float, str, bytes)


def pack(value: object) -> bytes:
    """Return `value` as one message.

    Tuples become lists. float64, str_ and bytes_ scalars are packed as plain numbers, strings and bytes, because numpy
    derives these types from Python's own types and msgpack accepts them as such.

    Raises:
        CodecError: the format cannot represent the value.
    """
    try:
        packed: bytes = msgpack.packb(value, default=_encode)
    except (TypeError, ValueError, OverflowError) as error:
        raise CodecError(f"cannot pack {type(value).__name__}: {error}") from error
    return packed


def unpack(payload: bytes | bytearray | memoryview, limit: int = DEFAULT_LIMIT) -> Any:
    """Return the value of one message; its arrays are **read-only**: copy them before writing.

    Raises:
        CodecError: more than `limit` bytes, invalid msgpack, an array whose data do not fill its shape, an object,
            structured or complex type, or an array of another dialect (which is named).
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


def _encode(value: object) -> dict[bytes, object]:
    if isinstance(value, np.ndarray):
        _refuse_kind(value.dtype)
        return {
            b"__ndarray__": True,
            b"data": _bytes_of(value),
            b"dtype": value.dtype.str,
            b"shape": list(value.shape),
        }
    if isinstance(value, np.generic):
        _refuse_kind(value.dtype)
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise CodecError(
        f"cannot pack a {type(value).__name__}; allowed: numbers, strings, bytes, lists, maps, arrays"
    )


def _bytes_of(array: np.ndarray[Any, Any]) -> bytes | memoryview:
    # Pictures are the bulk of a message: memory that is in C order already is copied only once.
    if array.dtype.kind in _BUFFERED_KINDS and array.flags.c_contiguous:
        return array.data
    return array.tobytes()


def _decode(fields: dict[Any, Any]) -> object:
    if b"__ndarray__" in fields:
        return _array(fields)
    if b"__npgeneric__" in fields:
        return _scalar(fields)
    foreign = _foreign_dialect(fields)
    if foreign:
        raise CodecError(
            f"found an array in {foreign}; expected the openpi dialect (binary key '__ndarray__'). "
            "The peer uses another codec: it speaks another protocol than the one configured"
        )
    return fields


def _foreign_dialect(fields: Mapping[Any, Any]) -> str:
    if b"nd" in fields:
        return "the dialect MNP (package msgpack_numpy, as GR00T N1.7 sends it)"
    if "__ndarray_class__" in fields:
        return "the dialect NPY ('__ndarray_class__', as GR00T N1.5 and N1.6 send it)"
    if "__ndarray__" in fields or "__npgeneric__" in fields:
        return "the openpi dialect but with text keys"
    return ""


def _array(fields: Mapping[Any, Any]) -> np.ndarray[Any, Any]:
    dtype, data, shape = _dtype(fields), fields.get(b"data"), fields.get(b"shape")
    if not isinstance(data, bytes):
        raise CodecError(f"an array's data are {type(data).__name__}; expected bytes")
    if not isinstance(shape, list) or any(type(n) is not int or n < 0 for n in shape):
        raise CodecError(f"an array has the shape {shape!r}; expected a list of integers from 0 on")
    expected = dtype.itemsize * math.prod(shape)
    if dtype.itemsize == 0 or len(data) != expected:
        raise CodecError(f"an array of {dtype.str} {shape} needs {expected} bytes of data; given {len(data)}")
    try:
        return np.ndarray(shape, dtype, buffer=data)
    except (ValueError, TypeError) as error:
        raise CodecError(f"an array of {dtype.str} {shape} is impossible: {error}") from error


def _scalar(fields: Mapping[Any, Any]) -> object:
    dtype, data = _dtype(fields), fields.get(b"data")
    if not isinstance(data, _SCALARS):
        raise CodecError(f"a numpy scalar's data are {type(data).__name__}; expected a number or a string")
    try:
        with np.errstate(over="raise"):
            return dtype.type(data)
    except (TypeError, ValueError, ArithmeticError) as error:
        raise CodecError(f"{data!r} is no {dtype.str}: {error}") from error


def _dtype(fields: Mapping[Any, Any]) -> np.dtype[Any]:
    name = fields.get(b"dtype")
    if not isinstance(name, str):
        raise CodecError(f"an array's dtype is {name!r}; expected a string such as '<f4'")
    try:
        dtype = np.dtype(name)
    except (TypeError, ValueError, SyntaxError) as error:
        raise CodecError(
            f"an array's dtype is {name!r}, which numpy does not know; e.g. '<f4', '|u1'"
        ) from error
    _refuse_kind(dtype)
    return dtype


def _refuse_kind(dtype: np.dtype[Any]) -> None:
    if dtype.kind in _REFUSED_KINDS:
        raise CodecError(
            f"arrays of {dtype.str!r} are refused (objects, structures, complex numbers); "
            "allowed: bool, int, float, text"
        )
