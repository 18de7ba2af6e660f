from __future__ import annotations

from pathlib import Path
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from runtime.core import msgpack_arrays
from runtime.core.errors import CodecError

VECTORS = Path(__file__).parents[1] / "vectors"

BYTES_OF: list[tuple[object, str]] = [
    (
        np.array([1, 2], "<f4"),
        "84 c40b5f5f6e6461727261795f5f c3 c40464617461 c4080000803f00000040 c4056474797065 a33c6634"
        "c4057368617065 9102",
    ),
    (
        np.zeros((1, 1, 3), "u1"),
        "84 c40b5f5f6e6461727261795f5f c3 c40464617461 c403000000 c4056474797065 a37c7531"
        "c4057368617065 93010103",
    ),
    (
        np.float32(1.5),
        "83 c40d5f5f6e7067656e657269635f5f c3 c40464617461 cb3ff8000000000000 c4056474797065 a33c6634",
    ),
    (
        {"t": 1.5, "action": np.zeros(2, "<f4"), "target": "real"},
        "83 a174 cb3ff8000000000000 a6616374696f6e 84c40b5f5f6e6461727261795f5fc3c40464617461c408"
        "0000000000000000c4056474797065a33c6634c40573686170659102 a6746172676574 a47265616c",
    ),
    (
        {"t": 1.5, "action": np.zeros(1, "<f4"), "target": "hil_start", "mode": "relative"},
        "84 a174 cb3ff8000000000000 a6616374696f6e 84c40b5f5f6e6461727261795f5fc3c40464617461c404"
        "00000000c4056474797065a33c6634c40573686170659101 a6746172676574 a968696c5f7374617274 a46d6f6465"
        "a872656c6174697665",
    ),
]

MNP_ARRAY = bytes.fromhex("85c4026e64c3c40474797065a33c6634c4046b696e64c400c40573686170659102c40464617461")
MNP_ARRAY += bytes.fromhex("c4080000803f00000040")
MNP_SCALAR = bytes.fromhex("83c4026e64c2c40474797065a33c6634c40464617461c4040000c03f")


def array_map(**changes: object) -> dict[bytes, object]:
    fields: dict[bytes, object] = {
        b"__ndarray__": True,
        b"data": b"\0" * 8,
        b"dtype": "<f4",
        b"shape": [2],
    }
    return fields | {key.encode(): value for key, value in changes.items()}


@pytest.mark.parametrize(("value", "expected"), BYTES_OF)
def test_it_packs_the_recorded_bytes(value: object, expected: str) -> None:
    assert msgpack_arrays.pack(value) == bytes.fromhex(expected)


def test_it_reads_and_rewrites_a_recorded_openpi_request_byte_for_byte() -> None:
    recorded = (VECTORS / "openpi_infer_request.bin").read_bytes()
    request = msgpack_arrays.unpack(recorded)
    np.testing.assert_array_equal(request["state"], np.array([0.5, 1.0], np.float32))
    np.testing.assert_array_equal(
        request["images"]["cam_high"], np.arange(12, dtype=np.uint8).reshape(3, 2, 2)
    )
    assert request["prompt"] == "pick"
    assert msgpack_arrays.pack(request) == recorded


def test_it_reads_and_rewrites_a_recorded_openpi_reply_byte_for_byte() -> None:
    recorded = (VECTORS / "openpi_infer_reply.bin").read_bytes()
    reply = msgpack_arrays.unpack(recorded)
    np.testing.assert_array_equal(reply["actions"], np.array([[0, 0.25], [0.5, 0.75], [1, 1.25]], np.float32))
    np.testing.assert_array_equal(reply["origin_actions"], np.arange(9, dtype=np.float32).reshape(3, 3))
    assert reply["policy_timing"] == {"infer_ms": 1.5}
    assert msgpack_arrays.pack(reply) == recorded


KINDS = st.one_of(
    hnp.boolean_dtypes(),
    hnp.integer_dtypes(endianness="?"),
    hnp.unsigned_integer_dtypes(endianness="?"),
    hnp.floating_dtypes(endianness="?", sizes=(16, 32, 64)),
    hnp.unicode_string_dtypes(endianness="?", max_len=5),
    hnp.byte_string_dtypes(max_len=5),
)
ARRAYS = hnp.arrays(KINDS, hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4))


@given(ARRAYS)
def test_every_array_comes_back_equal_and_read_only(array: np.ndarray[Any, Any]) -> None:
    returned = msgpack_arrays.unpack(msgpack_arrays.pack(array))
    assert returned.dtype == array.dtype
    assert returned.shape == array.shape
    assert returned.tobytes() == array.tobytes()
    assert not returned.flags.writeable


@given(hnp.arrays(np.int32, hnp.array_shapes(min_dims=2, max_dims=3)))
def test_memory_order_does_not_matter(array: np.ndarray[Any, Any]) -> None:
    np.testing.assert_array_equal(msgpack_arrays.unpack(msgpack_arrays.pack(array.T)), array.T)
    np.testing.assert_array_equal(msgpack_arrays.unpack(msgpack_arrays.pack(array[::2])), array[::2])


LEAVES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**63), 2**64 - 1),
    st.floats(allow_nan=False),
    st.text(),
    st.binary(),
)
VALUES = st.recursive(
    LEAVES, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4)
)


@given(VALUES)
def test_plain_values_come_back_equal(value: object) -> None:
    marks = ("__ndarray_class__", "__ndarray__", "__npgeneric__")
    if not any(mark in repr(value) for mark in marks):
        assert msgpack_arrays.unpack(msgpack_arrays.pack(value)) == value


@pytest.mark.parametrize("scalar", [np.float32(1.5), np.int64(-3), np.bool_(True), np.uint8(200)])
def test_a_numpy_scalar_keeps_its_type(scalar: np.generic) -> None:
    returned = msgpack_arrays.unpack(msgpack_arrays.pack(scalar))
    assert returned == scalar
    assert returned.dtype == scalar.dtype


def test_a_tuple_becomes_a_list() -> None:
    assert msgpack_arrays.unpack(msgpack_arrays.pack((1, 2))) == [1, 2]


@pytest.mark.parametrize(
    "array",
    [
        np.array([{}], dtype=object),
        np.zeros(2, dtype=[("a", "<f4")]),
        np.zeros(2, dtype=np.complex64),
        np.complex64(1j),
    ],
)
def test_it_refuses_to_pack_objects_structures_and_complex_numbers(array: object) -> None:
    with pytest.raises(CodecError, match=r"objects, structures, complex"):
        msgpack_arrays.pack(array)


@pytest.mark.parametrize("value", [object(), {1, 2}, 2**70])
def test_it_refuses_to_pack_what_the_wire_does_not_know(value: object) -> None:
    with pytest.raises(CodecError, match="cannot pack"):
        msgpack_arrays.pack(value)


@pytest.mark.parametrize("dtype", ["|O", "O", "<c8", "<f4,<f4", "(2,)f4", "|V4"])
def test_it_refuses_to_unpack_objects_structures_and_complex_numbers(dtype: str) -> None:
    with pytest.raises(CodecError, match=r"refused|dtype"):
        msgpack_arrays.unpack(msgpack.packb(array_map(dtype=dtype)))


def test_a_pickled_array_is_refused_without_being_loaded(tmp_path: Path) -> None:
    witness = tmp_path / "loaded"
    hostile = f"cos\nsystem\n(S'touch {witness}'\ntR.".encode()
    for fields in (
        array_map(dtype="|O", data=hostile, shape=[1]),
        {b"nd": True, b"kind": b"O", b"data": hostile},
    ):
        with pytest.raises(CodecError):
            msgpack_arrays.unpack(msgpack.packb(fields))
    assert not witness.exists()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"shape": [3]}, "needs 12 bytes of data; given 8"),
        ({"shape": [2, -1]}, "shape"),
        ({"shape": [True]}, "shape"),
        ({"shape": "2"}, "shape"),
        ({"shape": [0, 2**62, 2**62], "data": b""}, "impossible"),
        ({"shape": [1] * 70, "data": b"\0" * 4}, "impossible"),
        ({"shape": [10**9], "dtype": "<U0", "data": b""}, "needs 0 bytes"),
        ({"data": "text"}, "data are str"),
        ({"data": None}, "data are NoneType"),
        ({"dtype": "<q9"}, "numpy does not know"),
        ({"dtype": "<f4("}, "numpy does not know"),
        ({"dtype": ["<f4"]}, "expected a string"),
        ({"dtype": None}, "expected a string"),
    ],
)
def test_it_refuses_an_array_that_does_not_fit_its_description(changes: dict[str, Any], says: str) -> None:
    with pytest.raises(CodecError, match=says):
        msgpack_arrays.unpack(msgpack.packb(array_map(**changes)))


@pytest.mark.parametrize("data", [[1], None, {"a": 1}])
def test_it_refuses_a_scalar_that_is_none(data: object) -> None:
    with pytest.raises(CodecError, match="scalar's data"):
        msgpack_arrays.unpack(msgpack.packb({b"__npgeneric__": True, b"data": data, b"dtype": "<f4"}))


@pytest.mark.parametrize(("data", "dtype"), [("x", "<f4"), (2**63, "|u1"), (1e300, "<f4")])
def test_it_refuses_a_scalar_that_its_type_cannot_hold(data: object, dtype: str) -> None:
    with pytest.raises(CodecError, match="is no"):
        msgpack_arrays.unpack(msgpack.packb({b"__npgeneric__": True, b"data": data, b"dtype": dtype}))


@pytest.mark.parametrize(
    ("payload", "dialect"),
    [
        (MNP_ARRAY, "MNP"),
        (MNP_SCALAR, "MNP"),
        (msgpack.packb({"actions": {"__ndarray_class__": True, "as_npy": b"\x93NUMPY"}}), "NPY"),
        (
            msgpack.packb({"a": [{"__ndarray__": True, "data": b"", "dtype": "<f4", "shape": [0]}]}),
            "text keys",
        ),
    ],
)
def test_it_names_the_dialect_of_a_foreign_array(payload: bytes, dialect: str) -> None:
    with pytest.raises(CodecError, match=dialect):
        msgpack_arrays.unpack(payload)


def test_it_names_the_dialect_of_an_array_that_msgpack_numpy_wrote() -> None:
    import msgpack_numpy

    payload = msgpack.packb({"actions": np.zeros((2, 3))}, default=msgpack_numpy.encode)
    with pytest.raises(CodecError, match="MNP"):
        msgpack_arrays.unpack(payload)


def test_it_refuses_a_message_beyond_the_limit() -> None:
    payload = msgpack_arrays.pack(np.zeros(1000, np.uint8))
    assert msgpack_arrays.unpack(payload, limit=len(payload)).shape == (1000,)
    with pytest.raises(CodecError, match=f"{len(payload)} bytes exceeds the limit of 999"):
        msgpack_arrays.unpack(payload, limit=999)


def outcome(payload: bytes) -> str:
    """Any other exception passes through and fails the test."""
    try:
        msgpack_arrays.unpack(payload)
    except CodecError:
        return "refused"
    return "decoded"


@given(st.binary(max_size=200))
def test_random_bytes_either_decode_or_raise_a_codec_error(payload: bytes) -> None:
    assert outcome(payload) in {"decoded", "refused"}


@given(st.integers(0, 10_000), st.integers(0, 255))
def test_a_broken_message_either_decodes_or_raises_a_codec_error(place: int, byte: int) -> None:
    payload = bytearray(
        msgpack_arrays.pack({"state": np.arange(3.0), "n": np.float32(2), "images": {"a": b"x"}})
    )
    payload[place % len(payload)] = byte
    assert outcome(bytes(payload)) in {"decoded", "refused"}


@pytest.mark.parametrize(
    "payload", [b"", b"\x81", b"\xc0\xc0", b"\xc1", b"\x81\xc0\xc0", b"\x91" * 5000 + b"\x00"]
)
def test_it_says_that_broken_bytes_are_no_message(payload: bytes) -> None:
    with pytest.raises(CodecError, match="not one msgpack message"):
        msgpack_arrays.unpack(payload)
