"""What a station says to preflights: when one may begin, what it is told, what ends it."""

from __future__ import annotations

from typing import Any

import pytest

from runtime.core.clock import VirtualClock
from runtime.core.errors import RuntimeFault
from runtime.ipc.messages import Command, Event
from runtime.ipc.session_state import SessionState
from runtime.processes.coordinator.preflight_service import PREFLIGHT_QUERIES, PreflightService
from runtime.station.preflight_child import PreflightRun
from tests.runtime.lockstep_station import Station, stubbed
from tests.runtime.preflight.bench import LEROBOT, WIRES, planned
from tests.standing import state_flags

OWN = planned(WIRES["openpi"], "ws://127.0.0.1:8000")
GRPC = "grpc://127.0.0.1:8080"


class Recorder:
    """Preflights that begin nothing."""

    def __init__(self) -> None:
        self.started: list[Any] = []
        self.cancelled: list[str] = []
        self.ended: PreflightRun | None = None

    def start(self, asked: Any, resolved: Any) -> float:
        self.started.append((asked, resolved))
        return 60.0

    def poll(self) -> PreflightRun | None:
        ended, self.ended = self.ended, None
        return ended

    def cancel(self, why: str) -> None:
        self.cancelled.append(why)

    def report(self, id: str) -> dict[str, Any]:
        if id != "one":
            raise RuntimeFault(f"preflight {id!r} is not known here")
        return {"running": True, "report": None, "failure": ""}

    def close(self) -> None:
        self.cancelled.append("closed")


class Desk:
    def __init__(self, in_force: Any = OWN) -> None:
        self.state = SessionState.IDLE
        self.events: list[Event] = []
        self.flights = Recorder()
        self.desk = PreflightService(
            lambda: in_force,
            OWN,
            lambda: self.state,
            self.events.append,
            VirtualClock(),
            self.flights,  # type: ignore[arg-type]
        )

    def ask(self, kind: str, **args: Any) -> Any:
        return self.desk.handle(Command("u1", kind, args, user="ann"), "boot-1")


@pytest.mark.parametrize("state", SessionState)
def test_it_begins_only_where_nothing_is_at_work(state: SessionState) -> None:
    desk = Desk()
    desk.state = state
    ack = desk.ask("preflight", id="one", checkpoint={"id": 1, "name": "pi0"})
    free = state not in (SessionState.SETTING_UP, SessionState.RUNNING, SessionState.HOLDING)
    assert (ack.status == "done") is free
    assert len(desk.flights.started) == free
    if free:
        assert ack.data == {"id": "one", "longest_s": 60.0}
        assert desk.events[0].text == "preflight of the checkpoint pi0 by ann"
    else:
        assert f"not allowed while {state}" in ack.reason


def test_what_it_is_asked_about_is_the_deployment_with_the_checkpoints_table() -> None:
    desk = Desk()
    desk.ask("preflight", id="one", policy={"url": "ws://127.0.0.1:9"}, task="fold", deadline_s=5)
    asked, resolved = desk.flights.started[0]
    assert resolved is OWN.resolved
    assert asked.changes == {"policy": {"url": "ws://127.0.0.1:9"}, "task": "fold"}


@pytest.mark.parametrize(
    ("args", "says"),
    [
        ({}, "id"),
        ({"id": "one", "colour": "blue"}, "colour = 'blue': unknown key"),
        ({"id": "one", "deadline_s": -1}, "deadline_s"),
    ],
)
def test_arguments_are_checked(args: dict[str, Any], says: str) -> None:
    ack = Desk().ask("preflight", **args)
    assert ack.status == "refused"
    assert says in ack.reason


def test_a_server_with_one_clients_checkpoint_is_not_taken_from_a_station_that_is_ready() -> None:
    desk = Desk(planned(WIRES["lerobot"], GRPC))
    desk.state = SessionState.READY
    table = {**LEROBOT, "url": "grpc://localhost:8080", "checkpoint": "user/other"}
    refused = desk.ask("preflight", id="one", policy=table)
    assert "ready to run with this server" in refused.reason
    assert desk.ask("preflight", id="one", policy={**table, "url": "grpc://127.0.0.1:9"}).status == "done"
    assert desk.ask("preflight", id="two", policy={"url": "ws://127.0.0.1:8080"}).status == "done"
    desk.state = SessionState.IDLE
    assert desk.ask("preflight", id="three", policy=table).status == "done"


def test_its_end_is_an_event_with_the_verdict_alone() -> None:
    desk = Desk()
    desk.flights.ended = PreflightRun(
        "one", "the checkpoint pi0", None, 0.0, {"verdict": "bad_shape", "sentence": "s"}
    )  # type: ignore[arg-type]
    desk.desk.poll()
    desk.flights.ended = PreflightRun("two", "the checkpoint pi1", None, 0.0, {}, "cancelled: run by ann")  # type: ignore[arg-type]
    desk.desk.poll()
    desk.desk.poll()
    assert [event.text for event in desk.events] == [
        "preflight of the checkpoint pi0: bad_shape",
        "preflight of the checkpoint pi1: cancelled: run by ann",
    ]
    assert desk.events[0].data == {"id": "one"}


def test_reports_and_servers_are_told() -> None:
    desk = Desk(planned(WIRES["openpi"], "ws://127.0.0.1:8001"))
    assert desk.ask("preflight_report", id="one").data["running"] is True
    assert "not known here" in desk.ask("preflight_report", id="two").reason
    assert desk.ask("policy_server").data == {"server": "127.0.0.1:8001", **state_flags("idle")}
    assert desk.ask("policy_server", policy={}).data["server"] == "127.0.0.1:8000"
    assert desk.ask("policy_server", policy={"url": "ws://gpu:7"}).data["server"] == "gpu:7"
    assert desk.ask("policy_server", policy={"uri": "x"}).status == "refused"
    assert set(PREFLIGHT_QUERIES) == {"preflight", "preflight_report", "policy_server"}


def test_a_station_takes_its_policy_back_for_a_set_up_and_for_a_run(tmp_path: Any, monkeypatch: Any) -> None:
    station = Station(stubbed(tmp_path))
    flights = Recorder()
    monkeypatch.setattr(station.coordinator.preflights, "_preflights", flights)
    try:
        station.until(lambda: station.state is SessionState.IDLE, 5.0, "first observation")
        assert station._handle("preflight", {"id": "one"}).status == "done"
        station.command("setup")
        assert flights.cancelled == ["setup by lockstep"]
        assert "not allowed while setting_up" in station._handle("preflight", {"id": "two"}).reason
        station.reach(SessionState.READY)
        station.command("run")
        assert flights.cancelled[1:] == ["run by lockstep"]
        station.go(3)
        assert "not allowed while running" in station._handle("preflight", {"id": "two"}).reason
        assert [asked.id for asked, _ in flights.started] == ["one"]
    finally:
        station.close()
    assert flights.cancelled[-1] == "closed"
