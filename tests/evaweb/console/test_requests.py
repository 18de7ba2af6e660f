"""What a page may say."""

from __future__ import annotations

import json
from uuid import uuid4

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaweb.console.requests import (
    Aim,
    BadRequest,
    Credit,
    EStop,
    Events,
    Renew,
    Stop,
    Watch,
    may_be_stop,
    parse,
)
from tests import presses

CAMERAS = ("cam_high", "cam_left_wrist")


def said(**message):
    return parse(json.dumps(message), CAMERAS)


def test_requests_are_read():
    uuid = uuid4()
    assert said(type="watch", streams=["state", "camera/cam_high"]) == Watch(("state", "camera/cam_high"))
    assert said(type="credit") == Credit()
    assert said(type="renew", epoch=3) == Renew(3)
    assert said(type="estop", uuid=str(uuid), why="smoke") == EStop(uuid, "smoke")
    assert said(type="stop", uuid=str(uuid), epoch=4) == Stop("stop", uuid, 4)
    assert said(type="halt", uuid=str(uuid), epoch=4) == Stop("halt", uuid, 4)
    assert said(type="events", after=7) == Events(7, "")
    assert said(type="watch", streams=["recent", "chunk"]) == Watch(("recent", "chunk"))
    assert said(type="aim", id=3, args={"pose": "home"}) == Aim(3, {"pose": "home"})
    assert said(type="events", after=7, boot="b") == Events(7, "b")


@pytest.mark.parametrize(
    ("message", "sentence"),
    [
        (
            {"type": "jump"},
            "type 'jump' is unknown; allowed: watch, estop, credit, renew, stop, halt, events, aim",
        ),
        ({"type": "watch", "streams": "state"}, "streams = 'state'; allowed: a list of state, joints"),
        ({"type": "watch", "streams": ["camera/none"]}, "camera/cam_left_wrist"),
        ({"type": "watch", "streams": [["state"]]}, "allowed: a list of"),
        ({"type": "renew", "epoch": "3"}, "epoch = '3'; allowed: a whole number"),
        ({"type": "renew", "epoch": True}, "epoch = True"),
        ({"type": "events", "after": -1}, "after = -1"),
        ({"type": "events", "after": 0, "boot": 5}, "boot = 5; allowed: a text"),
        ({"type": "aim", "id": 1}, "args = None; allowed: a map"),
        ({"type": "aim", "id": -1, "args": {}}, "id = -1; allowed: a whole number"),
        ({"type": ["watch"]}, "is unknown"),
    ],
)
def test_what_means_nothing_is_refused_with_what_is_allowed(message, sentence):
    with pytest.raises(BadRequest, match=sentence):
        said(**message)


def test_a_text_that_is_nested_too_deeply_is_a_bad_request():
    with pytest.raises(BadRequest, match="tables or lists within each other; allowed: at most 40"):
        parse("[" * 60_000, ())


@pytest.mark.parametrize("rest", ['"why": ' + "[" * 60_000, '"why": ', ""])
def test_a_press_of_the_e_stop_is_one_also_where_the_rest_cannot_be_read(rest):
    assert isinstance(parse('{"type" : "estop", ' + rest, ()), EStop)


@pytest.mark.parametrize("name", presses.in_json("type"))
def test_whatever_is_wrong_with_a_press_it_is_one(name):
    text = presses.in_json("type")[name]
    pressed = parse(text, CAMERAS)
    assert isinstance(pressed, EStop)
    assert 0 < len(pressed.why) <= 240
    assert may_be_stop(text), "also from a page that floods"


@given(presses.json_texts("type"))
def test_any_mutation_of_a_press_that_still_names_it_is_one(text):
    assert isinstance(parse(text, CAMERAS), EStop)


@pytest.mark.parametrize("extra", [{}, {"uuid": 7, "why": 3}, {"uuid": "x", "why": "y" * 999}])
def test_an_estop_is_pressed_whatever_else_is_wrong(extra):
    pressed = said(type="estop", **extra)
    assert isinstance(pressed, EStop)
    assert 0 < len(pressed.why) <= 240


@given(st.text())
def test_a_text_at_random_is_a_bad_request_and_nothing_worse(text):
    with pytest.raises(BadRequest):
        parse(text, CAMERAS)
