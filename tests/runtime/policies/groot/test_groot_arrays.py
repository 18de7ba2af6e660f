from __future__ import annotations

import contextlib
import io
import struct
from pathlib import Path
from typing import Any

import msgpack
import msgpack_numpy
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of

from runtime.core import msgpack_arrays
from runtime.core.errors import CodecError
from runtime.policies.groot import arrays

VECTORS = Path(__file__).parents[2] / "vectors"
LIMIT = 1 << 20
MNP_ARRAY = bytes.fromhex(
    "85c4026e64c3c40474797065a33c6634c4046b696e64c400c4057368617065 9102c40464617461c4080000803f00000040"
)
MNP_SCALAR = bytes.fromhex("83c4026e64c2c40474797065a33c6634c40464617461c4040000c03f")
PICTURE = np.arange(12, dtype=np.uint8).reshape(1, 1, 2, 2, 3)
STATE = (np.arange(6, dtype=np.float32) / np.float32(10)).reshape(1, 1, 6)
ACTIONS = (np.arange(12, dtype=np.float32) / 8).reshape(1, 2, 6)
REQUEST = {
    "endpoint": "get_action",
    "data": {
        "observation": {
            "video": {"ego_view": PICTURE},
            "state": {"single_arm": STATE},
            "language": {"annotation.human.task_description": [["pick"]]},
        },
        "options": None,
    },
}
PLAIN = st.sampled_from(["<f4", "<f8", "|u1", "<i8", "|b1", ">f4", "<f2", "<u2"]).map(np.dtype)
ARRAYS = arrays_of.arrays(PLAIN, arrays_of.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4))


def vector(name: str) -> bytes:
    return (VECTORS / f"{name}.bin").read_bytes()


def npy(array: Any, **options: Any) -> dict[str, object]:
    file = io.BytesIO()
    np.save(file, array, **options)
    return {"__ndarray_class__": True, "as_npy": file.getvalue()}


def unpacked(value: object) -> Any:
    return arrays.unpack(msgpack.packb(value), LIMIT)


def test_a_request_has_the_bytes_of_the_real_client() -> None:
    assert arrays.pack(REQUEST) == vector("gr00t_n16_get_action_request")


@pytest.mark.parametrize("name", ["gr00t_n16_get_action_reply", "gr00t_n17_get_action_reply_mnp"])
def test_answers_of_real_servers_are_read_in_either_form(name: str) -> None:
    actions, information = arrays.unpack(vector(name), LIMIT)
    np.testing.assert_array_equal(actions["single_arm"], ACTIONS)
    np.testing.assert_array_equal(actions["gripper"], np.ones((1, 2, 1), np.float32))
    assert actions["single_arm"].dtype == np.float32
    assert information == {"n": 1}


@pytest.mark.parametrize("name", ["gr00t_n16_get_action_request", "gr00t_n17_get_action_request_mnp"])
def test_requests_of_real_clients_are_read_too(name: str) -> None:
    message = arrays.unpack(vector(name), LIMIT)
    observation = message["data"]["observation"]
    np.testing.assert_array_equal(observation["video"]["ego_view"], PICTURE)
    np.testing.assert_array_equal(observation["state"]["single_arm"], STATE)


def test_the_published_package_writes_what_is_read() -> None:
    np.testing.assert_array_equal(arrays.unpack(MNP_ARRAY, LIMIT), np.array([1, 2], "<f4"))
    assert arrays.unpack(MNP_SCALAR, LIMIT) == np.float32(1.5)


@given(ARRAYS)
def test_every_plain_array_comes_back_from_both_forms(array: np.ndarray[Any, Any]) -> None:
    for payload in (arrays.pack({"a": array}), msgpack.packb({"a": array}, default=msgpack_numpy.encode)):
        back = arrays.unpack(payload, LIMIT)["a"]
        assert back.dtype == array.dtype
        assert back.shape == array.shape
        assert back.tobytes() == array.tobytes()


def test_what_is_in_columns_comes_back_in_its_shape() -> None:
    array = np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3))
    np.testing.assert_array_equal(unpacked(npy(array)), array)


def test_numpy_scalars_travel_as_plain_numbers() -> None:
    assert arrays.pack({"a": np.float32(1.5), "b": np.int64(3)}) == msgpack.packb({"a": 1.5, "b": 3})


@pytest.mark.parametrize("value", [object(), np.array([None]), np.zeros(1, complex), np.array(["a"])])
def test_what_the_dialect_cannot_carry_is_refused(value: object) -> None:
    with pytest.raises(CodecError, match="cannot pack"):
        arrays.pack({"a": value})


class Bomb:
    def __reduce__(self) -> Any:
        return (pytest.fail, ("it was unpickled",))


def hostile() -> list[tuple[object, str]]:
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1099511627776,), }"
    huge = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + b"\0\0\0\0"
    return [
        (npy(np.array([Bomb()], object), allow_pickle=True), "objects"),
        ({b"nd": True, b"type": "|O", b"kind": b"O", b"shape": [1], b"data": b"\x80\x04N."}, "kind b'O'"),
        ({b"nd": True, b"type": "|O", b"kind": b"", b"shape": [1], b"data": b"12345678"}, "refused"),
        ({b"complex": True, b"data": "1j"}, "complex"),
        (npy(np.zeros(2, "f4,f4")), "plain type"),
        (npy(np.array(["text"])), "refused"),
        ({"__ndarray_class__": True, "as_npy": huge}, "does not fit 4 bytes"),
        ({"__ndarray_class__": True, "as_npy": huge[:8]}, "version 1 or 2"),
        ({"__ndarray_class__": True, "as_npy": b"\x93NUMPY\x07\x00\x00\x00\x00\x00"}, "version 1 or 2"),
        ({"__ndarray_class__": True, "as_npy": "text"}, "bytes of a .npy file"),
        ({"__ndarray_class__": True}, "bytes of a .npy file"),
        ({b"nd": True, b"type": "<f4", b"kind": b"", b"shape": [3], b"data": b"1234"}, "does not fit"),
        ({b"nd": True, b"type": "<f4", b"kind": b"", b"shape": [-1], b"data": b"1234"}, "shape"),
        ({b"nd": True, b"type": "<f4", b"kind": b"", b"shape": "x", b"data": b"1234"}, "shape"),
        ({b"nd": True, b"type": "f4,f4", b"kind": b"", b"shape": [1], b"data": b"12345678"}, "dtype"),
        ({b"nd": True, b"type": 4, b"kind": b"", b"shape": [1], b"data": b"1234"}, "dtype"),
        ({b"nd": True, b"type": "<f4", b"kind": b"", b"shape": [1], b"data": "text"}, "expected bytes"),
        ({b"nd": True, b"type": "<f4", b"kind": b"", b"shape": [1] * 64, b"data": b"1234"}, "does not fit"),
    ]


@pytest.mark.parametrize(("value", "says"), hostile())
def test_what_could_do_harm_is_refused_and_named(value: object, says: str) -> None:
    with pytest.raises(CodecError, match=says):
        unpacked({"a": value})


def test_openpis_arrays_are_named() -> None:
    with pytest.raises(CodecError, match="openpi dialect"):
        arrays.unpack(msgpack_arrays.pack({"actions": ACTIONS}), LIMIT)


def test_a_message_that_is_too_long_is_refused_unread() -> None:
    with pytest.raises(CodecError, match="exceeds the limit of 8"):
        arrays.unpack(b"123456789", 8)


@given(st.binary(max_size=300))
def test_random_bytes_are_a_value_or_an_error(payload: bytes) -> None:
    with contextlib.suppress(CodecError):
        arrays.unpack(payload, LIMIT)


@given(st.data(), st.sampled_from(["gr00t_n16_get_action_reply", "gr00t_n17_get_action_reply_mnp"]))
def test_cut_and_bent_answers_are_a_value_or_an_error(data: Any, name: str) -> None:
    payload = bytearray(vector(name))
    del payload[data.draw(st.integers(0, len(payload))) :]
    for place in data.draw(st.lists(st.integers(0, max(0, len(payload) - 1)), max_size=4)):
        if payload:
            payload[place] = data.draw(st.integers(0, 255))
    with contextlib.suppress(CodecError):
        arrays.unpack(bytes(payload), LIMIT)
