from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from runtime.core.errors import TransportError
from runtime.core.types import RobotCommand
from runtime.ipc.session_state import SessionState
from runtime.ipc.shared_state import SharedState, SharedStateLayout
from runtime.processes.control.node_peers import SubscriberCheck
from runtime.transports.base import Sink
from tests.runtime.lockstep_station import Station, stubbed

WHY = "a subscriber of /right is incompatible in its reliability"


class Mouth(Sink):
    """A sink of which the test says who hears it."""

    def __init__(self) -> None:
        self.found: dict[str, str] = {}
        self.error = ""
        self.asked = 0

    def connect(self) -> None:
        raise AssertionError("nobody connects here")

    def send(self, command: RobotCommand) -> None:
        raise AssertionError("nobody sends here")

    def missing_subscribers(self) -> dict[str, str]:
        self.asked += 1
        if self.error:
            raise TransportError(self.error)
        return dict(self.found)

    def close(self) -> None:
        pass


class Desk:
    """Looks at a mouth, tick by tick at 10 Hz."""

    def __init__(self) -> None:
        self.shared, _ = SharedState.create(SharedStateLayout(dim=2, eef_dim=8, cameras=(), picture_bytes=16))
        self.mouth = Mouth()
        self.said: list[tuple[str, str, Mapping[str, Any]]] = []
        self._hearing = SubscriberCheck(self.shared, self.mouth, lambda *event: self.said.append(event))
        self.now = 100.0
        self.shared.beat("coordinator", self.now)

    def go(self, seconds: float) -> list[tuple[str, str, Mapping[str, Any]]]:
        """What is said meanwhile."""
        self.said.clear()
        for _ in range(round(seconds * 10)):
            self.now += 0.1
            self._hearing.poll(self.now)
        return list(self.said)


@pytest.fixture
def desk() -> Desk:
    return Desk()


def test_nothing_is_said_where_all_is_heard_and_who_knows_is_not_asked_at_every_tick(desk: Desk) -> None:
    assert desk.go(20.0) == []
    assert 9 <= desk.mouth.asked <= 11


def test_who_does_not_hear_is_said_once_and_that_it_does_once(desk: Desk) -> None:
    desk.mouth.found = {"/right": WHY, "/left": ""}
    said = ("commands_unheard", f"/left: no subscriber; {WHY}", {"unheard": desk.mouth.found})
    assert desk.go(30.0) == [said]
    desk.mouth.found = {"/right": WHY}
    assert desk.go(30.0) == [("commands_unheard", WHY, {"unheard": {"/right": WHY}})]
    desk.mouth.found = {}
    assert desk.go(30.0) == [("commands_heard", "all command topics have a subscriber", {"unheard": {}})]
    assert desk.go(30.0) == []


def test_a_transport_that_cannot_say_says_that_once(desk: Desk) -> None:
    desk.mouth.error = "nobody can say"
    assert desk.go(30.0) == [("commands_unheard", "nobody can say", {"unheard": {"": "nobody can say"}})]


def test_a_main_that_is_started_anew_is_told_again_when_it_is_there(desk: Desk) -> None:
    desk.mouth.found = {"/left": ""}
    assert len(desk.go(5.0)) == 1
    desk.shared.beat("coordinator", 0.0)
    assert desk.go(5.0) == []
    desk.shared.beat("coordinator", desk.now)
    assert [text for _, text, _ in desk.go(5.0)] == ["/left: no subscriber"]


def test_it_is_in_the_status_before_anything_is_set_up_and_leaves_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    station = Station(stubbed(tmp_path))
    found = {"/left": ""}
    monkeypatch.setattr(station.robot, "missing_subscribers", lambda: dict(found), raising=False)
    station.go(90)
    assert station.state is SessionState.IDLE
    assert station.coordinator.snapshot()["link"]["unheard"] == {"/left": ""}
    found.clear()
    station.go(90)
    assert station.coordinator.snapshot()["link"]["unheard"] == {}
    kinds = [event["kind"] for event in station.coordinator.events.since(0)]
    assert [kind for kind in kinds if kind.startswith("commands_")] == ["commands_unheard", "commands_heard"]
    station.close()
