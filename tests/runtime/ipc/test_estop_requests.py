"""What is a press of the e-stop, in each wire format, and what is none."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.ipc.estop_requests import (
    DEFAULT_REASON,
    LONGEST,
    json_reason,
    parse_json_press,
    parse_packed_press,
)
from runtime.ipc.messages import Command, decode, encode
from tests import presses


@pytest.mark.parametrize("name", presses.PACKED)
def test_a_message_of_the_bus_that_says_so_is_a_press_whatever_is_wrong_with_it(name: str) -> None:
    press = parse_packed_press(presses.PACKED[name])
    assert press is not None
    assert press.kind == "estop"
    assert 0 < len(press.uuid) <= 64
    assert len(press.args["why"]) <= 2 * LONGEST
    assert decode(encode(press)) == press, "it can be sent on and written down"


def test_a_press_with_nothing_wrong_is_read_as_it_was_written() -> None:
    assert parse_packed_press(presses.WHOLE) == Command("u", "estop", {"why": "smoke"}, "ann", "ann")


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("args is a list", "pressed (message: args is no map)"),
        ("a why that is a number", "pressed (message: why is no text)"),
        ("a uuid that is a number", "smoke (message: uuid is no text)"),
        ("a uuid of 70 KB", "smoke (message: uuid has 70000 characters)"),
        ("bytes behind it", "smoke (message: unreadable: 2 bytes follow it)"),
        ("a why of 70 KB", "y" * LONGEST),
    ],
)
def test_what_was_wrong_is_said_in_the_reason(name: str, why: str) -> None:
    press = parse_packed_press(presses.PACKED[name])
    assert press is not None
    assert press.args["why"] == why


@pytest.mark.parametrize("name", presses.OTHERS)
def test_a_message_of_another_kind_is_no_press_though_the_word_is_in_it(name: str) -> None:
    assert parse_packed_press(presses.OTHERS[name]) is None


@given(presses.packed())
def test_any_mutation_on_the_bus_that_still_names_it_presses(payload: bytes) -> None:
    press = parse_packed_press(payload)
    assert press is not None
    assert decode(encode(press)) == press


@given(st.binary())
def test_bytes_without_the_word_are_no_press(payload: bytes) -> None:
    assert parse_packed_press(payload) is None or b"estop" in payload


@pytest.mark.parametrize("key", ["type", "kind"])
@pytest.mark.parametrize("name", presses.in_json("kind"))
def test_a_message_in_json_that_says_so_is_a_press_whatever_is_wrong_with_it(key: str, name: str) -> None:
    text = presses.in_json(key)[name]
    for said in (text, text.encode("utf-8"), text.encode("utf-16"), text.encode() + b"\xff"):
        found = parse_json_press(said, key)
        assert found is not None
        assert 0 < len(json_reason(found)) <= LONGEST


@given(presses.json_texts("type"))
def test_any_mutation_in_json_that_still_names_it_presses(text: str) -> None:
    assert parse_json_press(text, "type") is not None


@pytest.mark.parametrize(
    "said",
    [
        {"type": "aim", "args": {"type": "estop"}},
        {"type": "watch", "streams": ["estop"]},
        {"type": "events", "boot": 'type: "estop"'},
        {"type": "estops"},
        {"name": "estop"},
        ["estop"],
        "estop",
    ],
)
def test_json_that_says_something_else_is_no_press(said: object) -> None:
    assert parse_json_press(json.dumps(said), "type") is None


@given(st.text() | st.binary())
def test_a_text_without_the_word_is_no_press(said: str | bytes) -> None:
    assert parse_json_press(said, "type") is None or ("estop" if isinstance(said, str) else b"estop") in said


@pytest.mark.parametrize(
    ("said", "why"),
    [
        ({"why": "smoke"}, "smoke"),
        ({"args": {"why": "smoke"}}, "smoke"),
        ({"arguments": {"why": "smoke"}, "why": ""}, "smoke"),
        ({"why": [], "args": 3}, DEFAULT_REASON),
        ({"why": "a\x00\ud800"}, "a?"),
    ],
)
def test_the_reason_is_found_where_people_write_it(said: dict[str, object], why: str) -> None:
    assert json_reason(said) == why


@pytest.mark.parametrize("many", [3_000, 200_000])
def test_a_long_message_is_looked_at_where_it_begins_and_ends(many):
    """What whoever sends a lot costs must not keep the presses of others waiting."""
    noise = ("kind" + " " * 9 + ":" + " " * 9) * (many // 22)
    assert parse_json_press(noise + "\\u0041 estop", "kind") in (None, {})
    looked = []
    told = parse_json_press(
        '{"kind": "estop", "why": "smoke", "uuid": "u-1", "args": "' + "x" * many + '"}', "kind"
    )
    looked.append(told)
    looked.append(
        parse_json_press(
            '{"args": "' + "x" * many + '", "uuid": "u-1", "why": "smoke", "kind": "estop"}', "kind"
        )
    )
    assert [(one["why"], one["uuid"]) for one in looked] == [("smoke", "u-1")] * 2
    assert parse_json_press('{"kind": "move", "args": "' + "estop " * many + '"}', "kind") is None


def test_a_long_message_that_is_no_press_is_not_parsed(monkeypatch):
    monkeypatch.setattr("runtime.ipc.estop_requests._JSON", None)
    assert parse_json_press("[" + '{"a":1},' * 20_000 + '{"type": "\\u0041 estop"}]', "kind") is None
