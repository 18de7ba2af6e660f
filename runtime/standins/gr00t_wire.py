"""Messages as GR00T's servers write and read them: arrays are numpy's own files, or maps made by hand.

Nothing of the client's code is used.
"""

from __future__ import annotations

import io
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np


class Pickled:
    """Stands for an array of pickled objects."""


def packed(value: object, modern: bool, foreign: bool = False) -> bytes:
    """One message; arrays as the package msgpack_numpy has them (N1.7, `modern`), as .npy files, or as openpi does."""

    def written(given: object) -> object:
        if isinstance(given, Pickled):
            pickled = {
                b"nd": True,
                b"type": "|O",
                b"kind": b"O",
                b"shape": [1],
                b"data": b"\x80\x04]\x94N\x61.",
            }
            return pickled if modern else _file(np.array([None]), True)
        assert isinstance(given, np.ndarray), f"a {type(given).__name__} cannot be packed"
        name, shape, data = given.dtype.str, list(given.shape), given.tobytes()
        if foreign:
            return {b"__ndarray__": True, b"data": data, b"dtype": name, b"shape": shape}
        if modern:
            return {b"nd": True, b"type": name, b"kind": b"", b"shape": shape, b"data": data}
        return _file(given)

    made: bytes = msgpack.packb(value, default=written)
    return made


def unpacked(payload: bytes, npy: bool = True, mnp: bool = True) -> Any:
    """The value of one message, with arrays of the forms that the server reads; others stay maps, as with GR00T's."""

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
