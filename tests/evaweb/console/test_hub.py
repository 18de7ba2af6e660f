"""A station is heard once and encoded once, however many watch it."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from evaweb.console import hub as hubs
from evaweb.console import parts
from evaweb.console.hub import Encoder
from evaweb.frames import decode

Q = np.full(14, 0.1, np.float32)


def encoded(content, robot="agilex_piper", stream="joints"):
    made = Encoder(robot).encode(stream, content)
    return decode(parts.frame(made, 1, 0.0))


def joints(measured=Q, commanded=Q, engaged=True):
    return {"step": 3, "measured": measured, "commanded": commanded, "engaged": engaged}


def test_joints_become_numbers_and_the_poses_of_all_parts():
    frame = encoded(joints(commanded=Q + 0.1))
    assert frame.header["streams"]["joints"]["json"] == {"step": 3, "engaged": True}
    assert np.allclose(frame.array("joints", "commanded"), Q + 0.1)
    measured, commanded = frame.array("poses")
    assert measured.shape == (20, 16)
    assert not np.allclose(measured, commanded)


def test_what_the_policy_wants_and_what_is_planned_are_numbers_too():
    nothing = np.full(14, np.nan, np.float32)
    frame = encoded(joints() | {"raw": nothing, "planned": Q + 0.2})
    assert frame.header["streams"]["joints"]["json"] == {"step": 3, "engaged": True}
    assert np.isnan(frame.array("joints", "raw")).all()
    assert np.allclose(frame.array("joints", "planned"), Q + 0.2)


@pytest.mark.parametrize(
    "content", [joints(engaged=False), joints(commanded=np.full(14, np.nan, np.float32))]
)
def test_what_is_not_commanded_is_not_drawn(content):
    assert encoded(content).array("poses").shape == (20, 16)


@pytest.mark.parametrize(
    ("content", "robot"),
    [
        (joints(measured=np.full(14, np.nan, np.float32)), "agilex_piper"),
        (joints(measured=Q[:7], commanded=Q[:7]), "agilex_piper"),
        (joints(), "nobody"),
    ],
)
def test_what_cannot_be_drawn_is_still_told(content, robot):
    frame = encoded(content, robot)
    assert set(frame.header["streams"]) == {"joints"}


def test_events_and_link_are_no_parts():
    assert Encoder("agilex_piper").encode("events", object()) == []


@pytest.mark.django_db(transaction=True)
def test_viewers_of_the_same_are_sent_the_very_same_bytes(live, ann):
    async def scenario():
        loop = asyncio.get_running_loop()
        room = hubs.LiveHub(loop).room(live.name, live.robot)
        got = [[], []]
        boxes = [room.join(sent.append) for sent in got]
        for box in boxes:
            room.watch(box, ["state"])
        while not all(any(isinstance(message, bytes) for message in sent) for sent in got):
            await asyncio.sleep(0.01)
        first, second = (next(m for m in sent if isinstance(m, bytes)) for sent in got)
        assert first is second
        for box in boxes:
            room.leave(box)

    asyncio.run(scenario())
