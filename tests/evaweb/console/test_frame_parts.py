"""Parts put together are the message that evaweb.core.binary_frames reads."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from evaweb.console import frame_parts
from evaweb.core.binary_frames import Stream, decode, encode

VALUES = arrays.arrays("<f4", arrays.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=4))
NAMES = st.text(min_size=1, max_size=6)


@given(st.dictionaries(NAMES, VALUES, min_size=1, max_size=3), VALUES, st.binary(max_size=30), NAMES)
def test_a_frame_of_parts_is_read_like_one_encoded_at_once(values, poses, jpeg, said):
    words = {"said": said, "age": float("nan")}
    made = [
        frame_parts.encode_facts("state", words, 1.0),
        frame_parts.encode_numbers("joints", words, values, 1.0),
        frame_parts.encode_array("poses", poses, 1.0),
        frame_parts.encode_picture("camera/a", jpeg, 1.0),
    ]
    found = decode(frame_parts.build_frame(made, number=7, now=1.25))
    wanted = decode(
        encode(
            {
                "state": Stream(words),
                "joints": Stream(words, values),
                "poses": Stream(body=poses),
                "camera/a": Stream(body=jpeg, facts={"mime": "image/jpeg", "age": 0.25}),
            },
            frame=7,
            t=1.25,
        )
    )
    assert found.header == wanted.header
    assert bytes(found.body) == bytes(wanted.body)


def test_the_same_part_serves_frames_in_which_it_stands_elsewhere():
    picture = frame_parts.encode_picture("camera/a", b"12345", 1.0)
    joints = frame_parts.encode_numbers("joints", {}, {"measured": np.arange(3, dtype=np.float32)}, 1.0)
    first = decode(frame_parts.build_frame([picture, joints], 1, 1.0))
    second = decode(frame_parts.build_frame([joints, picture], 2, 2.0))
    for frame in (first, second):
        assert frame.data("camera/a") == b"12345"
        assert frame.array("joints", "measured").tolist() == [0, 1, 2]
    assert second.header["streams"]["camera/a"]["age"] == 1.0


def test_an_empty_frame_is_a_frame():
    assert decode(frame_parts.build_frame([], 1, 0.5)).header == {"frame": 1, "t": 0.5, "streams": {}}
