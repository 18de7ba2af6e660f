"""Our serialization of ROS 1 against rosbags', which knows nothing of us, and against bytes that are none."""

from __future__ import annotations

import contextlib
from dataclasses import astuple
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from runtime.errors import CodecError
from runtime.transports.ros import packed
from runtime.transports.ros.messages import (
    MESSAGES,
    PACKAGES,
    CompressedImage,
    Image,
    JointState,
    Message,
    MessageName,
    PoseStamped,
)

NAMES: list[MessageName] = list(MESSAGES)
TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
STAMPS = st.integers(0, 2**31 * 10**9 - 1)  # as far as rosbags goes; ROS 1 goes to 2106
FINITE = st.floats(allow_nan=False)
DOUBLES = arrays.arrays(np.float64, st.integers(0, 9), elements=FINITE)
BYTES = arrays.arrays(np.uint8, st.integers(0, 40))
U32 = st.integers(0, 2**32 - 1)
JOINTS = st.builds(JointState, STAMPS, TEXT, st.lists(TEXT, max_size=4).map(tuple), DOUBLES, DOUBLES, DOUBLES)
IMAGES = st.builds(Image, STAMPS, TEXT, U32, U32, TEXT, U32, BYTES)
COMPRESSED = st.builds(CompressedImage, STAMPS, TEXT, TEXT, BYTES)
POSES = st.builds(PoseStamped, STAMPS, TEXT, arrays.arrays(np.float64, 7, elements=FINITE))
ANY = st.one_of(JOINTS, IMAGES, COMPRESSED, POSES)


def name_of(message: Message) -> MessageName:
    return next(name for name, kind in MESSAGES.items() if isinstance(message, kind))


def same(one: Message, other: Message) -> bool:
    pairs = zip(astuple(one), astuple(other), strict=True)
    return all(np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b for a, b in pairs)


@settings(deadline=None)
@given(ANY)
def test_what_was_written_is_read_again(message: Message) -> None:
    assert same(packed.decode(name_of(message), packed.encode(message)), message)


@settings(deadline=None)
@given(ANY)
def test_every_truncation_and_every_remainder_is_refused(message: Message) -> None:
    payload = packed.encode(message)
    for end in range(len(payload)):
        with pytest.raises(CodecError):
            packed.decode(name_of(message), payload[:end])
    with pytest.raises(CodecError, match="has 1 behind its last field"):
        packed.decode(name_of(message), payload + b"\0")


@settings(deadline=None, max_examples=300)
@given(st.sampled_from(NAMES), st.binary(max_size=120))
def test_random_bytes_are_a_message_or_a_codec_error(name: MessageName, payload: bytes) -> None:
    with contextlib.suppress(CodecError):
        assert isinstance(packed.decode(name, payload), MESSAGES[name])


def test_seconds_are_unsigned() -> None:
    late = PoseStamped(2**32 * 10**9 - 1, "", np.zeros(7))
    assert same(packed.decode("PoseStamped", packed.encode(late)), late)


def test_a_length_beyond_the_message_reserves_nothing() -> None:
    header = bytes(12) + bytes(4)
    with pytest.raises(CodecError, match="announces 4294967295 strings"):
        packed.decode("JointState", header + b"\xff\xff\xff\xff")


def test_a_stamp_with_a_second_of_nanoseconds_is_refused() -> None:
    with pytest.raises(CodecError, match="1000000000 nanoseconds"):
        packed.decode("PoseStamped", bytes(8) + (10**9).to_bytes(4, "little") + bytes(60))


def test_the_bytes_are_those_of_the_definition() -> None:
    payload = packed.encode(JointState(5_000_000_001, "b", ("j1",), np.array([0.5])))
    assert payload == bytes.fromhex(
        "00000000 05000000 01000000 01000000 62"  # seq, seconds, nanoseconds, frame
        "01000000 02000000 6a31"
        "01000000 000000000000e03f"
        "00000000 00000000"
    )


@settings(deadline=None)
@given(ANY)
def test_rosbags_writes_the_same_bytes_and_reads_ours(message: Message) -> None:
    store = typestore()
    name = f"{PACKAGES[name_of(message)]}/msg/{name_of(message)}"
    theirs = bytes(store.serialize_ros1(foreign(store, message), name))
    assert theirs == packed.encode(message)
    assert same(packed.decode(name_of(message), theirs), message)


_STORE: list[Any] = []


def typestore() -> Any:
    if not _STORE:
        typesys = pytest.importorskip("rosbags.typesys", reason="rosbags (extra dev) is not installed")
        _STORE.append(typesys.get_typestore(typesys.Stores.ROS1_NOETIC))
    return _STORE[0]


def foreign(store: Any, message: Message) -> Any:
    """The same message as rosbags has it."""
    made = store.types
    time = made["builtin_interfaces/msg/Time"](*divmod(message.stamp, 10**9))
    header = made["std_msgs/msg/Header"](0, time, message.frame)
    if isinstance(message, JointState):
        kind = made["sensor_msgs/msg/JointState"]
        return kind(header, list(message.names), message.position, message.velocity, message.effort)
    if isinstance(message, Image):
        fields = (message.height, message.width, message.encoding, 0, message.step, message.data)
        return made["sensor_msgs/msg/Image"](header, *fields)
    if isinstance(message, CompressedImage):
        return made["sensor_msgs/msg/CompressedImage"](header, message.format, message.data)
    point = made["geometry_msgs/msg/Point"](*message.pose[:3])
    turn = made["geometry_msgs/msg/Quaternion"](*message.pose[3:])
    return made["geometry_msgs/msg/PoseStamped"](header, made["geometry_msgs/msg/Pose"](point, turn))


def test_the_bytes_of_a_picture_are_not_copied() -> None:
    read = packed.decode(
        "Image", packed.encode(Image(5, "camera", 4, 4, "rgb8", 12, np.arange(48, dtype=np.uint8)))
    )
    assert isinstance(read, Image)
    assert not read.data.flags.owndata
    assert not read.data.flags.writeable
