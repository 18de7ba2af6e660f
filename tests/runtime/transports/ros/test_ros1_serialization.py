"""Our serialization of ROS 1 against rosbags', which knows nothing of us, and against bytes that are none."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.core.errors import CodecError
from runtime.transports.ros import ros1_serialization
from runtime.transports.ros.messages import (
    Image,
    JointState,
    Message,
    MessageName,
    PoseStamped,
)
from tests.examples import some
from tests.runtime.transports.ros.drawn import MESSAGES, NAMES, Rosbags, messages, name_of, same

TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
STAMPS = st.integers(0, 2**31 * 10**9 - 1)  # as far as rosbags goes; ROS 1 goes to 2106
ANY = messages(TEXT, STAMPS)
ROSBAGS = Rosbags("ROS1_NOETIC", 0)


@given(ANY)
def test_what_was_written_is_read_again(message: Message) -> None:
    assert same(ros1_serialization.decode(name_of(message), ros1_serialization.encode(message)), message)


@given(ANY)
def test_every_truncation_and_every_remainder_is_refused(message: Message) -> None:
    payload = ros1_serialization.encode(message)
    for end in range(len(payload)):
        with pytest.raises(CodecError):
            ros1_serialization.decode(name_of(message), payload[:end])
    with pytest.raises(CodecError, match="has 1 behind its last field"):
        ros1_serialization.decode(name_of(message), payload + b"\0")


@settings(max_examples=some(300))
@given(st.sampled_from(NAMES), st.binary(max_size=120))
def test_random_bytes_are_a_message_or_a_codec_error(name: MessageName, payload: bytes) -> None:
    with contextlib.suppress(CodecError):
        assert isinstance(ros1_serialization.decode(name, payload), MESSAGES[name])


def test_seconds_are_unsigned() -> None:
    late = PoseStamped(2**32 * 10**9 - 1, "", np.zeros(7))
    assert same(ros1_serialization.decode("PoseStamped", ros1_serialization.encode(late)), late)


def test_a_length_beyond_the_message_reserves_nothing() -> None:
    header = bytes(12) + bytes(4)
    with pytest.raises(CodecError, match="announces 4294967295 strings"):
        ros1_serialization.decode("JointState", header + b"\xff\xff\xff\xff")


def test_a_stamp_with_a_second_of_nanoseconds_is_refused() -> None:
    with pytest.raises(CodecError, match="1000000000 nanoseconds"):
        ros1_serialization.decode("PoseStamped", bytes(8) + (10**9).to_bytes(4, "little") + bytes(60))


def test_the_bytes_are_those_of_the_definition() -> None:
    payload = ros1_serialization.encode(JointState(5_000_000_001, "b", ("j1",), np.array([0.5])))
    assert payload == bytes.fromhex(
        "00000000 05000000 01000000 01000000 62"  # seq, seconds, nanoseconds, frame
        "01000000 02000000 6a31"
        "01000000 000000000000e03f"
        "00000000 00000000"
    )


@given(ANY)
def test_rosbags_writes_the_same_bytes_and_reads_ours(message: Message) -> None:
    theirs = bytes(ROSBAGS.store.serialize_ros1(ROSBAGS.message(message), ROSBAGS.kind(message)))
    assert theirs == ros1_serialization.encode(message)
    assert same(ros1_serialization.decode(name_of(message), theirs), message)


def test_the_bytes_of_a_picture_are_not_copied() -> None:
    read = ros1_serialization.decode(
        "Image",
        ros1_serialization.encode(Image(5, "camera", 4, 4, "rgb8", 12, np.arange(48, dtype=np.uint8))),
    )
    assert isinstance(read, Image)
    assert not read.data.flags.owndata
    assert not read.data.flags.writeable
