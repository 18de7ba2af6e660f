"""Our CDR against rosbags', which knows nothing of us, and against bytes that are none."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.core.errors import CodecError
from runtime.transports.ros import cdr
from runtime.transports.ros.messages import (
    Image,
    Message,
    MessageName,
    PoseStamped,
)
from tests.runtime.transports.ros.drawn import NAMES, Rosbags, messages, name_of, same

TEXT = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=12)
STAMPS = st.integers(-(2**31) * 10**9, (2**31) * 10**9 - 1)

ANY = messages(TEXT, STAMPS)
ROSBAGS = Rosbags("ROS2_JAZZY")


@given(ANY)
def test_what_was_written_is_read_again(message: Message) -> None:
    assert same(cdr.decode(name_of(message), cdr.encode(message)), message)


@given(ANY)
def test_every_truncation_is_refused(message: Message) -> None:
    payload = cdr.encode(message)
    for size in range(len(payload)):
        with pytest.raises(CodecError):
            cdr.decode(name_of(message), payload[:size])


@given(st.sampled_from(NAMES), st.binary(max_size=120), st.booleans())
def test_random_bytes_are_a_message_or_refused(name: MessageName, garbage: bytes, headed: bool) -> None:
    payload = b"\x00\x01\x00\x00" + garbage if headed else garbage
    with contextlib.suppress(CodecError):
        assert name_of(cdr.decode(name, payload)) == name


def test_a_length_beyond_the_message_is_refused_without_reserving_memory() -> None:
    huge = b"\x00\x01\x00\x00" + bytes(8) + b"\x01\x00\x00\x00\x00" + bytes(3) + b"\xff\xff\xff\xff"
    for name in NAMES:
        with pytest.raises(CodecError):
            cdr.decode(name, huge)


def test_other_representations_are_refused_by_what_they_begin_with() -> None:
    payload = cdr.encode(PoseStamped(0, "", np.zeros(7)))
    with pytest.raises(CodecError, match="begins with 00070000; expected plain CDR"):
        cdr.decode("PoseStamped", b"\x00\x07" + payload[2:])


def test_big_endian_is_read() -> None:
    payload = (
        bytes.fromhex("00000000 00000001 00000002 00000002 6100 0000")
        + np.arange(7.0).astype(">f8").tobytes()
    )
    message = cdr.decode("PoseStamped", payload)
    assert same(message, PoseStamped(1_000_000_002, "a", np.arange(7.0)))


@given(ANY)
def test_rosbags_writes_the_same_bytes_and_reads_ours(message: Message) -> None:
    theirs = bytes(ROSBAGS.store.serialize_cdr(ROSBAGS.message(message), ROSBAGS.kind(message)))
    assert theirs == cdr.encode(message)
    assert same(cdr.decode(name_of(message), theirs), message)


def test_the_bytes_of_a_picture_are_not_copied() -> None:
    picture = Image(5, "camera", 4, 4, "rgb8", 12, np.arange(48, dtype=np.uint8))
    read = cdr.decode("Image", cdr.encode(replace(picture, stamp=6)))
    assert isinstance(read, Image)
    assert not read.data.flags.owndata
    assert not read.data.flags.writeable
