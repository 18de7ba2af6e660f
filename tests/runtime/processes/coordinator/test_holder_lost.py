"""A run whose holder is lost, in whole stations in lockstep: it holds, or goes on to its end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from runtime.core.errors import ConfigurationError, SetupError
from runtime.ipc.bus import Endpoints
from runtime.ipc.session_state import SessionState
from tests.runtime.lockstep_station import Station, stubbed

FINISH = {"lease": {"lost": "finish"}, "panel": {}}
TRIAL = {"trial": {"uuid": "7"}, "duration_s": 9.0}
Running = Callable[..., Station]


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    """A station that runs, with its panel served."""
    made: list[Station] = []

    def run(settings: dict[str, object], served: bool = True, **asked: object) -> Station:
        station = Station(stubbed(tmp_path, **settings)).ready()
        made.append(station)
        if served:
            Endpoints(station.spec.deployment.station_dir).write("panel", {"panel": "http://127.0.0.1:8480"})
        station.command("run", **asked)
        station.go(5)
        return station

    yield run
    for station in made:
        station.close()


def alone(station: Station, seconds: float) -> Station:
    """Let time pass while nothing is heard of the holder."""
    end = station.clock.now() + seconds
    while station.clock.now() < end:
        station.tick()
    return station


@pytest.mark.exhaustive
def test_a_scored_run_goes_on_to_its_limit_without_its_holder(running: Running) -> None:
    station = alone(running(FINISH, **TRIAL), 6.0)
    assert station.state is SessionState.RUNNING
    assert station.reason.startswith("no operator: the lease was not renewed; the scored run")
    assert station.coordinator.snapshot()["lease"]["holder"] == ""
    assert station.events("state")[-1].startswith("running -> running: no operator")
    sent = len(station.robot.commands)
    alone(station, 3.5)
    assert len(station.robot.commands) > sent
    assert (station.state, station.reason) == (SessionState.READY, "the run's 9 s are over")
    episode = station.coordinator.runs.last_episode
    assert (episode["status"], episode["reason"]) == ("finished", "the run's 9 s are over")


@pytest.mark.some(2)
@pytest.mark.parametrize(
    ("settings", "served", "asked"),
    [
        pytest.param({}, True, TRIAL, id="hold"),
        pytest.param(FINISH, False, TRIAL, id="nobody could stop it"),
        pytest.param(FINISH, True, {"duration_s": 9.0}, id="not scored"),
        pytest.param(FINISH, True, {"trial": {"uuid": "7"}}, id="no end"),
    ],
)
def test_every_other_run_holds(
    running: Running, settings: dict[str, object], served: bool, asked: dict[str, object]
) -> None:
    station = alone(running(settings, served, **asked), 6.0)
    assert station.state is SessionState.HOLDING
    assert station.reason == "the lease was not renewed: claim it, then resume or stop"


def test_it_holds_as_soon_as_nobody_could_stop_it_any_more(running: Running) -> None:
    station = alone(running(FINISH, **TRIAL), 6.0)
    assert station.state is SessionState.RUNNING
    Endpoints(station.spec.deployment.station_dir).withdraw("panel")
    alone(station, 0.5)
    assert station.state is SessionState.HOLDING
    assert station.reason.startswith("no operator: its panel ended as well")


@pytest.mark.some(1)
@pytest.mark.parametrize("how", ["given up", "hidden"])
def test_who_leaves_a_scored_run_of_his_own_will_holds_it(running: Running, how: str) -> None:
    station = running(FINISH, **TRIAL)
    if how == "given up":
        station._handle("lease_give_up")
    else:
        station._handle("lease_renew", {"hidden": True})
    assert alone(station, 6.0).state is SessionState.HOLDING


@pytest.mark.exhaustive
def test_a_run_that_holds_without_its_holder_does_not_go_on_by_itself(running: Running) -> None:
    station = alone(running(FINISH, **TRIAL), 6.0)
    station.robot.silent = True
    alone(station, 4.0)
    assert station.state is SessionState.HOLDING
    station.robot.silent = False
    assert alone(station, 3.0).state is SessionState.HOLDING


def test_finish_is_refused_where_nobody_beside_the_robot_could_stop_it(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigurationError, match=r'lease.lost = "finish": .* a person beside it must be able to stop it'
    ):
        stubbed(tmp_path, lease={"lost": "finish"})


def test_a_run_that_has_not_begun_does_not_begin_without_its_holder(running: Running) -> None:
    station = running(FINISH)
    station.command("stop")
    station.go(5)
    real = station.coordinator.runs.on_episode_opened
    station.coordinator.runs.on_episode_opened = lambda message, running: ""  # media takes its time
    station.command("run", **TRIAL)
    alone(station, 6.0)
    station.coordinator.runs.on_episode_opened = real
    assert station.state is SessionState.HOLDING
    with pytest.raises(SetupError, match="not allowed"):
        station.command("run")
