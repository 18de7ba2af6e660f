"""Codec of GR00T's messages for its stand-in: arrays are .npy files, or maps in the format of msgpack_numpy.

It shares no code with the client's codec, so that tests with the stand-in can find errors in the client's codec.
"""

from __future__ import annotations

import io
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np


class Pickled:
    """Placeholder for an array of pickled objects."""


def packed(value: object, modern: bool, foreign: bool = False) -> bytes:
    """Pack `value` as one message.

    `modern` and `foreign` select the form of arrays. If `foreign`, arrays have openpi's form. Otherwise they have the
    form of msgpack_numpy if `modern` (as in N1.7), else the .npy form.
    """

    def written(item: object) -> object:
        if isinstance(item, Pickled):
            pickled = {
                b"nd": True,
                b"type": "|O",
                b"kind": b"O",
                b"shape": [1],
                b"data": b"\x80\x04]\x94N\x61.",
            }
            return pickled if modern else _file(np.array([None]), True)
        assert isinstance(item, np.ndarray), f"a {type(item).__name__} cannot be packed"
        name, shape, data = item.dtype.str, list(item.shape), item.tobytes()
        if foreign:
            return {b"__ndarray__": True, b"data": data, b"dtype": name, b"shape": shape}
        if modern:
            return {b"nd": True, b"type": name, b"kind": b"", b"shape": shape, b"data": data}
        return _file(item)

    payload: bytes = msgpack.packb(value, default=written)
    return payload


def unpacked(payload: bytes, npy: bool = True, mnp: bool = True) -> Any:
    """Unpack one message; arrays are read as .npy if `npy`, and as msgpack_numpy encodes them if `mnp`.

    Arrays in other formats remain maps, as in GR00T's server.
    """

    def read(fields: dict[Any, Any]) -> object:
        if npy and "__ndarray_class__" in fields:
            return np.load(io.BytesIO(fields["as_npy"]), allow_pickle=False)
        if mnp and fields.get(b"nd") is True and fields[b"kind"] == b"":
            return np.ndarray(fields[b"shape"], fields[b"type"], buffer=fields[b"data"])
        return fields

    return msgpack.unpackb(payload, object_hook=read)


def _file(array: np.ndarray[Any, Any], pickled: bool = False) -> dict[str, object]:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=pickled)
    return {"__ndarray_class__": True, "as_npy": file.getvalue()}
