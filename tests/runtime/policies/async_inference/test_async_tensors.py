from __future__ import annotations

import pickle
import struct
from typing import Any

import numpy as np
import pytest

from runtime.core.errors import CodecError
from runtime.policies.async_inference.pickles import Reader
from runtime.policies.async_inference.tensors import Tensors

MAGIC = 119547037146038801333356
MACHINE = {"protocol_version": 1001, "little_endian": True, "type_sizes": {"short": 2, "int": 4, "long": 4}}
KINDS = {
    "Float": "<f4", "Double": "<f8", "Half": "<f2", "Long": "<i8", "Int": "<i4", "Short": "<i2", "Char": "|i1",
    "Byte": "|u1", "Bool": "|b1",
}  # fmt: skip


def text(word: str) -> bytes:
    return b"X" + struct.pack("<I", len(word)) + word.encode()


def said(kind: str, count: int, key: str = "7", view: bytes = b"N", module: str = "torch") -> bytes:
    name = f"c{module}\n{kind}Storage\n".encode()
    return (
        b"\x80\x02("
        + text("storage")
        + name
        + text(key)
        + text("cpu")
        + b"J"
        + struct.pack("<i", count)
        + view
        + b"tQ."
    )


def file(
    kind: str, elements: bytes, count: int, *, head: Any = None, told: bytes | None = None, keys: Any = ("7",)
) -> bytes:
    parts = head or (MAGIC, 1001, MACHINE)
    return b"".join(
        [
            *(pickle.dumps(part, 2) for part in parts),
            said(kind, count) if told is None else told,
            pickle.dumps(list(keys), 2),
            struct.pack("<q", count),
            elements,
        ]
    )


def storage(data: object) -> np.ndarray[Any, Any]:
    return Tensors(Reader).storage(data)


@pytest.mark.parametrize(("kind", "dtype"), KINDS.items())
def test_every_kind_of_number_is_read(kind: str, dtype: str) -> None:
    array = np.array([0, 1, 1, 0]).astype(dtype)
    found = storage(file(kind, array.tobytes(), 4))
    np.testing.assert_array_equal(found, array)
    assert found.dtype == np.dtype(dtype)


def test_bfloat16_becomes_float32() -> None:
    numbers = np.array([0.5, -1.25, 384.0], np.float32)
    half = (numbers.view(np.uint32) >> 16).astype("<u2")
    np.testing.assert_array_equal(storage(file("BFloat16", half.tobytes(), 3)), numbers)


F4 = np.arange(4, dtype="<f4").tobytes()


@pytest.mark.parametrize(
    ("data", "says"),
    [
        ("text", "expected bytes"),
        (file("Float", F4[:-1], 4), "15 bytes of data"),
        (file("Float", F4, 5), "of 5 elements"),
        (file("Float", F4, 4, told=said("Float", 3)), "of 3 elements"),
        (file("Float", F4, 4, keys=("8",)), "elements"),
        (file("Float", F4, 4, told=said("Float", 4, view=b"K\x01")), "elements"),
        (
            file("Float", F4, 4, told=said("Complex", 4)),
            r"torch.ComplexStorage is refused; allowed: torch\.Float",
        ),
        (file("Float", F4, 4, told=said("Float", 4, module="os")), "os.FloatStorage is refused"),
        (file("Float", F4, 4, head=(1, 1001, MACHINE)), "does not begin"),
        (file("Float", F4, 4, head=(MAGIC, 1001, 3)), "does not begin"),
        (file("Float", F4, 4, head=(MAGIC, 1001, {**MACHINE, "little_endian": False})), "big-endian"),
        (file("Float", F4, 4, told=pickle.dumps(("storage", "x"), 2)), "says that it is"),
        (file("Float", F4, 4, told=pickle.dumps(["storage"], 2)), "says that it is"),
    ],
)
def test_what_is_no_storage_is_named(data: object, says: str) -> None:
    with pytest.raises(CodecError, match=says):
        storage(data)


@pytest.mark.parametrize(
    ("offset", "size", "stride", "expected"),
    [
        (0, (6,), (1,), [0, 1, 2, 3, 4, 5]),
        (2, (2,), (1,), [2, 3]),
        (0, (2, 3), (3, 1), [[0, 1, 2], [3, 4, 5]]),
        (0, (3, 2), (1, 3), [[0, 3], [1, 4], [2, 5]]),
        (1, (2,), (2,), [1, 3]),
        (5, (), (), 5),
        (6, (0,), (1,), []),
        (0, (3,), (0,), [0, 0, 0]),
    ],
)
def test_views_show_what_torch_would(offset: int, size: Any, stride: Any, expected: Any) -> None:
    made = Tensors(Reader).tensor(np.arange(6.0), offset, size, stride, False, {})
    np.testing.assert_array_equal(made, expected)
    assert made.flags.owndata or made.ndim == 0


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((None, 0, (1,), (1,)), "not made of a storage"),
        ((np.arange(6), 0, [1], (1,)), "not made of a storage"),
        ((np.arange(6), 0, (7,), (1,)), "does not fit 6"),
        ((np.arange(6), 3, (2, 2), (2, 1)), "does not fit 6"),
        ((np.arange(6), 7, (0,), (1,)), "does not fit 6"),
        ((np.arange(6), -1, (1,), (1,)), "offset -1"),
        ((np.arange(6), 0, (1,), (-1,)), "strides"),
        ((np.arange(6), 0, (1.0,), (1,)), "sizes"),
        ((np.arange(6), 0, (1, 1), (1,)), "sizes"),
        ((np.arange(6), 0, (1 << 40,), (0,)), "more than 10000000 elements"),
        ((np.arange(6), 0, (1,) * 40, (0,) * 40), "does not fit"),
    ],
)
def test_views_of_what_is_not_there_are_refused(arguments: Any, says: str) -> None:
    with pytest.raises(CodecError, match=says):
        Tensors(Reader).tensor(*arguments)


def test_many_large_views_of_one_number_are_refused_together() -> None:
    tensors = Tensors(Reader)
    tensors.tensor(np.arange(1), 0, (6_000_000,), (0,))
    with pytest.raises(CodecError, match="tensors of a message"):
        tensors.tensor(np.arange(1), 0, (6_000_000,), (0,))
