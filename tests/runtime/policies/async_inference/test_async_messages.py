from __future__ import annotations

import contextlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.core.errors import CodecError
from runtime.policies.async_inference import messages

VECTORS = Path(__file__).parents[2] / "vectors"


def test_an_observation_has_the_bytes_of_the_real_client() -> None:
    data = (VECTORS / "lerobot_timed_observation.bin").read_bytes()
    assert list(messages.encode_observations(data)) == [
        (VECTORS / "lerobot_observation_message.bin").read_bytes()
    ]


@pytest.mark.parametrize(
    ("data", "parts"),
    [
        ("010203", ["08031203010203"]),
        ("0001020304050607", ["0801120400010203", "0803120404050607"]),
        ("00010203040506070809", ["0801120400010203", "0802120404050607", "080312020809"]),
        ("", []),
    ],
)
def test_long_data_go_in_parts_that_say_which_they_are(data: str, parts: list[str]) -> None:
    size = 4 if len(parts) > 1 else messages.CHUNK
    assert [part.hex() for part in messages.encode_observations(bytes.fromhex(data), size)] == parts


def test_a_part_is_as_long_as_the_real_clients() -> None:
    first, second = messages.encode_observations(bytes(messages.CHUNK + 1))
    assert first[:6].hex() == "080112808080"
    assert second.hex() == "0803120100"


def test_setup_and_actions_are_the_real_ones() -> None:
    assert messages.encode_setup(b"\x80").hex() == "0a0180"
    assert messages.decode_actions(bytes.fromhex("0a028004")) == b"\x80\x04"
    assert messages.decode_actions(messages.EMPTY) == b""


def test_fields_that_a_newer_server_may_add_are_skipped() -> None:
    more = bytes.fromhex("1005 19" + "00" * 8 + "25" + "00" * 4 + "2a0161")
    assert messages.decode_actions(more + bytes.fromhex("0a028004") + more) == b"\x80\x04"


@pytest.mark.parametrize(
    ("broken", "says"),
    [
        ("0a05", "ends after"),
        ("0a", "no whole number"),
        ("ff" * 11, "no whole number"),
        ("0801", "wire type 0; expected 2"),
        ("13", "no protobuf message"),
        ("19000000", "ends after"),
    ],
)
def test_what_is_no_message_is_named(broken: str, says: str) -> None:
    with pytest.raises(CodecError, match=says):
        messages.decode_actions(bytes.fromhex(broken))


@given(st.binary(max_size=60))
def test_random_bytes_are_data_or_an_error(broken: bytes) -> None:
    with contextlib.suppress(CodecError):
        assert isinstance(messages.decode_actions(broken), bytes)


@given(st.binary(max_size=400))
def test_protobufs_own_classes_write_and_read_the_same(data: bytes) -> None:
    pytest.importorskip("google.protobuf", reason="the extra lerobot-grpc is not installed")
    from runtime.standins.lerobot_wire import MESSAGES

    assert messages.decode_actions(MESSAGES["Actions"](data=data).SerializeToString()) == data
    parts = [MESSAGES["Observation"].FromString(part) for part in messages.encode_observations(data, 100)]
    assert b"".join(part.data for part in parts) == data
    assert MESSAGES["PolicySetup"].FromString(messages.encode_setup(data)).data == data
