"""Questions about targets: the newest counts, and only those who may move a robot ask them."""

from __future__ import annotations

import asyncio
import threading

import numpy as np
import pytest

from evaweb.accounts.roles import Role
from evaweb.console import aim_queries as aims
from evaweb.console.aim_queries import AimQueries, query_aim
from evaweb.console.requests import Aim
from evaweb.stations.models import Station
from evaweb.stations.robot_geometry import drawn_robot
from runtime.ipc.messages import Ack
from tests.processes import PATIENCE_S

Q = [0.1] * 14
PIPER = drawn_robot("agilex_piper")


def test_a_target_comes_with_where_every_part_would_be(live, runtime):
    runtime.aim_says = Ack(
        "", "done", data={"joints": np.array(Q, np.float32), "reached": True, "distance": 0.5}
    )
    found = query_aim(live.name, "ann", {"pose": "home"}, PIPER)
    assert (found["ok"], found["reached"], found["distance"]) == (True, True, 0.5)
    assert np.allclose(found["joints"], Q)
    wanted = PIPER.poses(np.array(Q)).ravel()
    assert np.allclose(found["links"], wanted, atol=2e-5)
    assert [(asked.kind, asked.args, asked.user) for asked in runtime.aims] == [
        ("aim", {"pose": "home"}, "ann")
    ]


def test_a_refusal_has_its_sentence_and_no_parts(live, runtime):
    runtime.aim_says = Ack("", "refused", "pose = 'x' is unknown; web:bob:p1 holds the lease")
    assert query_aim(live.name, "ann", {"pose": "x"}, PIPER) == {
        "ok": False,
        "reason": "pose = 'x' is unknown; bob holds the lease",
        "links": [],
    }


@pytest.mark.parametrize("joints", [None, [0.0] * 3, [None] * 14])
def test_a_target_that_cannot_be_drawn_has_no_parts(live, runtime, joints):
    runtime.aim_says = Ack("", "done", data={"joints": joints})
    assert query_aim(live.name, "ann", {}, PIPER)["links"] == []


def test_a_robot_that_is_not_drawn_has_no_parts(live, runtime):
    runtime.aim_says = Ack("", "done", data={"joints": Q})
    assert query_aim(live.name, "ann", {}, None)["links"] == []


def test_a_station_that_is_away_is_a_reason():
    found = query_aim("bench-nowhere", "ann", {}, PIPER)
    reason = "bench-nowhere is not running: its runtime has to be started"
    sentence = {"id": "stations.runtime_client.not_running", "arguments": {"name": "bench-nowhere"}}
    assert found == {"ok": False, "reason": reason, "sentence": sentence}


def test_what_cannot_be_sent_never_reaches_the_station(live, runtime):
    found = query_aim(live.name, "ann", {"joints": [2**70]}, PIPER)
    assert (found["ok"], runtime.aims) == (False, [])
    assert "cannot be sent" in found["reason"]


class Page:
    """Asks, and keeps what it is told; the first question waits until `go`."""

    def __init__(self, monkeypatch, role=Role.OPERATOR):
        self.told, self.asked = [], []
        self.begun, self.go = threading.Event(), threading.Event()
        self.aims = AimQueries(Station(name="bench-1"), "ann", role, self.told.append, lambda: PIPER)
        monkeypatch.setattr(aims, "query_aim", self._aimed)

    def _aimed(self, station, username, args, looks):
        assert (station, looks) == ("bench-1", PIPER)
        self.asked.append(args["n"])
        self.begun.set()
        assert self.go.wait(PATIENCE_S)
        if args["n"] < 0:
            raise ValueError("broken")
        return {"ok": True}

    def says(self, number):
        return self.aims.submit(Aim(number, {"n": number}))


def test_while_one_question_is_under_way_the_newest_replaces_the_one_that_waits(monkeypatch):
    page = Page(monkeypatch)

    async def scenario():
        assert page.says(1)
        answering = asyncio.create_task(page.aims.answer())
        assert await asyncio.to_thread(page.begun.wait, 10)
        assert [page.says(number) for number in (2, 3, 4)] == [False, False, False]
        page.go.set()
        await answering
        assert page.says(5)  # nothing is under way any more
        await page.aims.answer()

    asyncio.run(scenario())
    assert page.asked == [1, 4, 5]
    assert page.told == [{"type": "aimed", "id": number, "ok": True} for number in (1, 4, 5)]


def test_a_question_that_breaks_does_not_end_the_asking(monkeypatch):
    page = Page(monkeypatch)
    page.go.set()

    async def scenario():
        assert page.aims.submit(Aim(1, {"n": -1}))
        with pytest.raises(ValueError, match="broken"):
            await page.aims.answer()
        assert page.says(2)
        await page.aims.answer()

    asyncio.run(scenario())
    assert page.told == [{"type": "aimed", "id": 2, "ok": True}]


def test_a_viewer_is_told_so_and_nothing_is_asked(monkeypatch):
    page = Page(monkeypatch, Role.VIEWER)
    assert not page.says(3)
    assert page.asked == []
    reason = "ann is a viewer; aiming needs an operator: ask an administrator"
    said = {
        "ok": False,
        "reason": reason,
        "sentence": {"id": "console.aim.viewer", "arguments": {"user": "ann"}},
    }
    assert page.told == [{"type": "aimed", "id": 3, **said}]
