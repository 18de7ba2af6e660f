"""Our CDR against rosbags', which knows nothing of us, and against bytes that are none."""

from __future__ import annotations

import contextlib
from dataclasses import astuple, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from runtime.errors import CodecError
from runtime.transports.ros import cdr
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
TEXT = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=12)
STAMPS = st.integers(-(2**31) * 10**9, (2**31) * 10**9 - 1)
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
    assert same(cdr.decode(name_of(message), cdr.encode(message)), message)


@settings(deadline=None)
@given(ANY)
def test_every_truncation_is_refused(message: Message) -> None:
    payload = cdr.encode(message)
    for size in range(len(payload)):
        with pytest.raises(CodecError):
            cdr.decode(name_of(message), payload[:size])


@settings(deadline=None)
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


@settings(deadline=None)
@given(ANY)
def test_rosbags_writes_the_same_bytes_and_reads_ours(message: Message) -> None:
    store = typestore()
    theirs = foreign(store, message)
    name = f"{PACKAGES[name_of(message)]}/msg/{name_of(message)}"
    assert bytes(store.serialize_cdr(theirs, name)) == cdr.encode(message)
    assert same(cdr.decode(name_of(message), bytes(store.serialize_cdr(theirs, name))), message)


_STORE: list[Any] = []


def typestore() -> Any:
    if not _STORE:
        typesys = pytest.importorskip("rosbags.typesys", reason="rosbags (extra dev) is not installed")
        _STORE.append(typesys.get_typestore(typesys.Stores.ROS2_JAZZY))
    return _STORE[0]


def foreign(store: Any, message: Message) -> Any:
    """The same message as rosbags has it."""
    made = store.types
    time = made["builtin_interfaces/msg/Time"](*divmod(message.stamp, 10**9))
    header = made["std_msgs/msg/Header"](time, message.frame)
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
    picture = Image(5, "camera", 4, 4, "rgb8", 12, np.arange(48, dtype=np.uint8))
    read = cdr.decode("Image", cdr.encode(replace(picture, stamp=6)))
    assert isinstance(read, Image)
    assert not read.data.flags.owndata
    assert not read.data.flags.writeable
