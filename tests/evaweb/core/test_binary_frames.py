"""The binary message of pages: what is put in comes out, at places that a browser can read."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from evaweb.core.binary_frames import (
    DTYPES,
    FrameError,
    Stream,
    decode,
    encode,
)

ARRAYS = st.sampled_from(DTYPES).flatmap(
    lambda dtype: arrays.arrays("<" + dtype, arrays.array_shapes(min_dims=1, max_dims=3, min_side=0))
)


@given(
    st.dictionaries(st.text(min_size=1, max_size=8), ARRAYS, max_size=4),
    st.binary(max_size=40),
    st.text(max_size=9),
)
def test_what_is_put_in_comes_out_at_multiples_of_eight(
    values: dict[str, np.ndarray], file: bytes, said: str
) -> None:
    message = encode(
        {
            "joints": Stream({"said": said}, values),
            "camera/a": Stream(body=file, facts={"mime": "image/jpeg"}),
        },
        frame=3,
    )
    frame = decode(message)
    assert frame.header["frame"] == 3
    assert frame.header["streams"]["joints"]["json"] == {"said": said}
    assert frame.data("camera/a") == file
    assert (len(message) - len(frame.body)) % 8 == 0
    for name, value in values.items():
        entry = frame.header["streams"]["joints"]["arrays"][name]
        assert entry["offset"] % 8 == 0
        found = frame.array("joints", name)
        assert found.dtype == value.dtype
        assert found.shape == value.shape
        assert found.tobytes() == value.tobytes()


def test_the_bytes_of_one_message_are_these() -> None:
    message = encode({"poses": Stream(body=np.array([[1.0, 2.0]], np.float32))}, t=0.5)
    text = b'{"t":0.5,"streams":{"poses":{"offset":0,"dtype":"f4","shape":[1,2]}}}'
    start = 4 + len(text)
    assert message == struct.pack("<I", len(text)) + text + bytes(-start % 8) + struct.pack("<2f", 1, 2)


def test_numbers_that_are_not_finite_are_null_in_the_header_and_kept_in_arrays() -> None:
    message = encode(
        {
            "state": Stream({"age": float("nan"), "deep": [{"v": float("inf")}], "np": np.float32("nan")}),
            "joints": Stream(arrays={"measured": np.array([np.nan, 1], np.float32)}),
        }
    )
    frame = decode(message)
    assert frame.header["streams"]["state"]["json"] == {"age": None, "deep": [{"v": None}], "np": None}
    assert np.isnan(frame.array("joints", "measured")[0])


def test_big_endian_arrays_are_turned_round() -> None:
    frame = decode(encode({"a": Stream(body=np.array([1.5], ">f4"))}))
    assert frame.array("a").tolist() == [1.5]


def test_an_array_that_no_browser_reads_in_place_is_refused_by_name() -> None:
    with pytest.raises(FrameError, match=r"joints.step is an array of int64; allowed: f4, f8, i4, u1"):
        encode({"joints": Stream(arrays={"step": np.arange(3)})})


@pytest.mark.parametrize(
    ("message", "sentence"),
    [
        (b"", "0 bytes has no header"),
        (struct.pack("<I", 90) + b"{}", "ends at byte 94, the message has 6"),
        (struct.pack("<I", 2) + b"{]", "no JSON"),
        (struct.pack("<I", 2) + json.dumps([]).encode(), "no streams"),
    ],
)
def test_what_is_no_message_is_refused_with_a_sentence(message: bytes, sentence: str) -> None:
    with pytest.raises(FrameError, match=sentence):
        decode(message)
