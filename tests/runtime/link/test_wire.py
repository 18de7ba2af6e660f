"""Messages of the link: recorded ones of each release, those of neighbours, and noise."""

import json
from dataclasses import fields
from pathlib import Path

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.core.errors import CodecError
from runtime.link import wire

RECORDED = sorted((Path(__file__).parent / "recorded").glob("release-*.json"))
MESSAGES = [
    wire.Hello(1, "0.1.0", "bench-7", "stops", bytes(16)),
    wire.Welcome(1, "0.1.0"),
    wire.Bye("the lab has withdrawn this station's key", 30.0),
    wire.Beat(bytes(range(16)), ["guard", "coordinator", "media"]),
    wire.Ask(7, "guard", "estop", True, bytes(16), 12, bytes(64)),
    wire.Answer(7, ""),
    wire.Credit(2, ["camera/"]),
    wire.Bundle(["state", "joints"]),
    wire.Offer("0b5ae4b4-6f0a-4a0e-9a53-1d2f6f4f2a10"),
    wire.Want("0b5ae4b4-6f0a-4a0e-9a53-1d2f6f4f2a10", "front.mp4", 65536, 65536),
    wire.Piece("0b5ae4b4-6f0a-4a0e-9a53-1d2f6f4f2a10", "front.mp4", 65536),
    wire.Labels("0b5ae4b4-6f0a-4a0e-9a53-1d2f6f4f2a10"),
    wire.Arrived("0b5ae4b4-6f0a-4a0e-9a53-1d2f6f4f2a10", "00" * 32),
    wire.Declined("0b5ae4b4-6f0a-4a0e-9a53-1d2f6f4f2a10", "the lab's disk is full", 60.0),
    wire.Enrol(1, "0.1.0", bytes(10), "robot-pc"),
    wire.Enrolled("bench-7", "the lab", bytes(32), 8471),
]


def test_every_message_comes_back_as_it_was_written():
    assert [wire.read(wire.write(one, b"part")) for one in MESSAGES] == [(one, [b"part"]) for one in MESSAGES]


@pytest.mark.parametrize("path", RECORDED, ids=lambda path: path.stem)
def test_what_a_neighbouring_release_says_is_understood(path):
    """A release's file is written once, by `recorded()` below, and never again."""
    said = json.loads(path.read_text())
    assert abs(said["release"] - wire.RELEASE) <= 1
    read = [wire.read([bytes.fromhex(one)])[0] for one in said["messages"]]
    assert [type(one).__name__ for one in read] == said["kinds"]
    if said["release"] == wire.RELEASE:
        assert read == MESSAGES


def recorded():
    """The file of this release: python -c "from tests.runtime.link.test_wire import recorded; print(recorded())"."""
    messages = [wire.write(one)[0].hex() for one in MESSAGES]
    kinds = [type(one).__name__ for one in MESSAGES]
    return json.dumps({"release": wire.RELEASE, "kinds": kinds, "messages": messages}, indent=1)


def test_there_is_a_recording_of_this_release():
    assert f"release-{wire.RELEASE}" in [path.stem for path in RECORDED]


@pytest.mark.parametrize("message", MESSAGES, ids=lambda one: type(one).__name__)
def test_a_field_that_only_the_next_release_has_is_passed_over(message):
    content = msgpack.unpackb(wire.write(message)[0]) | {"invented_later": [1, {"a": None}]}
    assert wire.read([msgpack.packb(content)]) == (message, [])


@pytest.mark.parametrize("apart", [-2, -1, 0, 1, 2, 10**9])
def test_releases_work_one_apart_and_else_both_are_named(apart):
    said = wire.apart(wire.RELEASE + apart, "9.9", "bench-7", lab_side=True)
    if abs(apart) <= 1:
        assert said == ""
    else:
        assert f"the lab has release {wire.RELEASE} of the link" in said
        assert f"the computer of bench-7 release {wire.RELEASE + apart} (version 9.9)" in said
    other = wire.apart(wire.RELEASE + apart, "9.9", "bench-7", lab_side=False)
    assert (f"the lab has release {wire.RELEASE + apart}" in other) == (abs(apart) > 1)


@pytest.mark.parametrize("message", MESSAGES, ids=lambda one: type(one).__name__)
def test_a_field_of_another_type_is_refused_by_name(message):
    content = msgpack.unpackb(wire.write(message)[0])
    for one in fields(message):
        with pytest.raises(CodecError, match=f"{type(message).__name__}: {one.name} is"):
            wire.read([msgpack.packb(content | {one.name: {"no": "such"}})])


@given(st.lists(st.binary(max_size=200), max_size=4))
def test_noise_is_refused_and_raises_nothing_else(frames):
    with pytest.raises(CodecError):
        wire.read(frames)


@given(st.sampled_from(MESSAGES), st.integers(0, 10**6), st.integers(0, 255))
def test_a_message_with_a_byte_changed_is_another_message_or_refused(message, at, byte):
    packed = bytearray(wire.write(message)[0])
    packed[at % len(packed)] = byte
    try:
        read = wire.read([bytes(packed)])[0]
    except CodecError:
        return
    assert type(read) in wire._KINDS.values()


def test_what_is_too_large_or_too_much_is_refused():
    with pytest.raises(CodecError, match="frames"):
        wire.read([b"x" * (wire.LARGEST_HEADER + 1)])
    with pytest.raises(CodecError, match="frames"):
        wire.read([b""] * (wire.MOST_PARTS + 2))
    with pytest.raises(CodecError, match="Bundle: streams"):
        wire.read(wire.write(wire.Bundle(["a"] * 65)))
