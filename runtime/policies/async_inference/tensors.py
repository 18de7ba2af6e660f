"""Tensors from pickled torch storages, with numpy alone.

A storage is a torch file in the old format: five consecutive pickles (magic number, version, machine, description,
keys), the number of elements as int64, and the elements. A tensor is a view of a storage: offset, sizes, strides.
Several tensors may be different rows of the same storage, as in the responses of LeRobot's server.
"""

from __future__ import annotations

import io
import math
import struct
from typing import Any

import numpy as np

from runtime.core.errors import CodecError

_MAGIC, _VERSION = 0x1950A86A20F9469CFC6C, 1001
_MOST_ELEMENTS = (
    10_000_000  # of all tensors of a message: strides of 0 could expand one element to any number
)
_MOST_DIMENSIONS = 32
_KINDS = {
    "FloatStorage": "<f4",
    "DoubleStorage": "<f8",
    "HalfStorage": "<f2",
    "BFloat16Storage": "<u2",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "CharStorage": "|i1",
    "ByteStorage": "|u1",
    "BoolStorage": "|b1",
}
Array = np.ndarray[Any, Any]


class Tensors:
    """Tensors of one message.

    Storages are cached by their bytes, because a server sends the same storage with each row. `reader` is the class of
    the pickle interpreter for plain data; the interpreter for storages is derived from it.
    """

    def __init__(self, reader: type[Any]) -> None:
        class Reader(reader):  # type: ignore[misc]
            """Pickle interpreter for the names and the description of a storage."""

            def find_class(self, module: str, name: str) -> Any:
                if module != "torch" or name not in _KINDS:
                    raise CodecError(
                        f"a storage that names {module}.{name} is refused; allowed: torch.{', '.join(_KINDS)}"
                    )
                return name

            def persistent_load(self, pid: Any) -> Any:
                return pid

        self._reader = Reader
        self._known: dict[bytes, Array] = {}
        self._left = _MOST_ELEMENTS

    def storage(self, data: object) -> Array:
        """Return the elements [n] of a pickled storage. Raises CodecError if `data` is not one."""
        if not isinstance(data, bytes):
            raise CodecError(f"a storage is {type(data).__name__}; expected bytes")
        if data not in self._known:
            try:
                self._known[data] = self._read(data)
            except CodecError:
                raise
            except Exception as error:  # a broken pickle may raise any exception, but has executed nothing
                raise CodecError(
                    f"{len(data)} bytes are no storage of torch's: {type(error).__name__}: {error}"
                ) from error
        return self._known[data]

    def _read(self, data: bytes) -> Array:
        file = io.BytesIO(data)
        magic, version, machine, storage, keys = (self._reader(file).load() for _ in range(5))
        if (magic, version) != (_MAGIC, _VERSION) or not isinstance(machine, dict):
            raise CodecError("a storage does not begin as torch's do")
        if machine.get("little_endian") is not True:
            raise CodecError("a storage was written by a big-endian machine")
        if (
            type(storage) is not tuple
            or len(storage) != 6
            or storage[0] != "storage"
            or storage[1] not in _KINDS
        ):
            raise CodecError(f"a storage says that it is {str(storage)[:80]}")
        kind, key, count, view = storage[1], storage[2], storage[4], storage[5]
        counted, raw = file.read(8), file.read()
        dtype = np.dtype(_KINDS[kind])
        whole = len(counted) == 8 and type(count) is int and struct.unpack("<q", counted)[0] == count
        if not whole or view is not None or keys != [key] or len(raw) != count * dtype.itemsize:
            raise CodecError(f"a storage of {count} elements of {kind} has {len(raw)} bytes of data")
        if kind == "BFloat16Storage":
            return (np.frombuffer(raw, dtype).astype(np.uint32) << 16).view(np.float32)
        return np.frombuffer(raw, dtype)

    def tensor(self, storage: object, offset: object, size: object, stride: object, *_: object) -> Array:
        """Return a copy of the elements of `storage` from `offset` on, as an array with these sizes and strides.

        Raises CodecError if they do not fit. Further arguments (gradient, hooks) are ignored.
        """
        if not isinstance(storage, np.ndarray) or type(size) is not tuple or type(stride) is not tuple:
            raise CodecError("a tensor is not made of a storage, sizes and strides")
        numbers = (offset, *size, *stride)
        if len(size) != len(stride) or not all(type(number) is int and number >= 0 for number in numbers):
            raise CodecError(f"a tensor has offset {offset}, sizes {size} and strides {stride}")
        start = int(numbers[0])
        # Offset of the last element from the first; the checks come before the view and its copy are made.
        reach = sum((count - 1) * step for count, step in zip(size, stride, strict=True)) if all(size) else -1
        if start + reach >= len(storage) or start > len(storage) or len(size) > _MOST_DIMENSIONS:
            raise CodecError(
                f"a tensor of sizes {size}, strides {stride} from {start} on does not fit {len(storage)} elements"
            )
        self._left -= math.prod(size)
        if self._left < 0:
            raise CodecError(f"the tensors of a message have more than {_MOST_ELEMENTS} elements")
        steps = [step * storage.itemsize for step in stride]
        return np.lib.stride_tricks.as_strided(storage[start:], size, steps).copy()
