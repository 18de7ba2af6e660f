"""What the coordinator publishes, over real sockets, of a station in lockstep."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq

from runtime.ipc.bus import Endpoints, Subscriber
from runtime.ipc.messages import Ack, Command, decode, encode
from runtime.processes.coordinator.process import CommandService
from tests.runtime.lockstep_station import DIM, Station, stubbed

PATIENCE = 500  # times 10 ms


class Watched:
    """A station whose streams a client reads."""

    def __init__(self, folder: Path) -> None:
        self._context: zmq.Context[Any] = zmq.Context()
        self.station = Station(stubbed(folder))
        self._service = CommandService(self.station.coordinator, self._context)
        endpoint = Endpoints(self.station.spec.deployment.station_dir).read("coordinator")["state"]
        self._reader = Subscriber(self._context, endpoint, "joints")
        self.serve = self._service.serve
        self.context, self.endpoints = self._context, Endpoints(self.station.spec.deployment.station_dir)

    def joints(self) -> dict[str, Any]:
        """The newest joints, of the step that the station is at."""
        step = int(self.station.shared.control.read()["step"])
        for _ in range(PATIENCE):
            self._service._due.clear()  # time stands still here
            self._service.serve(0.0)
            seen: dict[str, Any] = self._reader.receive(0.01).get("joints", {})
            if seen and seen["step"] == step:
                return seen
        raise AssertionError("no joints came through")

    def close(self) -> None:
        self.station.close()
        self._reader.close()
        self._service.close()
        self._context.destroy(linger=0)


@pytest.fixture
def watched(tmp_path: Path) -> Iterator[Watched]:
    made = Watched(tmp_path)
    yield made
    made.close()


def test_before_anything_is_planned_there_is_no_plan_to_show(watched: Watched) -> None:
    seen = watched.joints()
    assert [np.isnan(seen[name]).all() for name in ("raw", "planned")] == [True, True]
    watched.station.ready()
    seen = watched.joints()
    assert [np.isnan(seen[name]).all() for name in ("raw", "planned")] == [True, True]
    assert seen["engaged"] is False


def test_in_a_run_the_curves_are_those_of_one_step(watched: Watched) -> None:
    station = watched.station.running(30)
    seen = watched.joints()
    assert all(seen[name].shape == (DIM,) for name in ("measured", "raw", "planned", "commanded"))
    assert all(seen[name].dtype == np.float32 for name in ("measured", "raw", "planned", "commanded"))
    raw = station.coordinator.inference.raw_action(seen["step"])
    assert raw is not None
    assert np.allclose(seen["raw"], raw)
    assert np.allclose(seen["planned"], raw, atol=1e-4)  # every chunk of this policy wants the same
    assert np.allclose(seen["commanded"], seen["planned"], atol=0.02)
    assert not np.allclose(seen["measured"], seen["raw"], atol=1e-4)  # it was measured before it was told
    episode = station.stop()
    row = episode.smoothed["step"].to_pylist().index(seen["step"])
    assert np.allclose(seen["planned"], episode.smoothed["smoothed"][row].as_py())


def test_after_a_run_nothing_is_planned_any_more(watched: Watched) -> None:
    watched.station.running(30).stop()
    seen = watched.joints()
    assert np.isnan(seen["raw"]).all()
    assert np.isnan(seen["planned"]).all()
    assert seen["engaged"] is True


class Asker:
    """A client that asks and does not wait."""

    def __init__(self, watched: Watched) -> None:
        self._watched = watched
        self._socket = watched.context.socket(zmq.DEALER)
        self._socket.connect(watched.endpoints.read("coordinator")["commands"])

    def ask(self, uuid: str, **arguments: Any) -> None:
        self._socket.send(encode(Command(uuid, "aim", arguments)))

    def answers(self, count: int) -> list[Ack]:
        """What has been answered after a while of service, `count` at least."""
        found: list[Ack] = []
        for _ in range(PATIENCE):
            self._watched.serve(0.01)
            while self._socket.poll(0):
                message = decode(self._socket.recv())
                assert isinstance(message, Ack)
                found.append(message)
            if len(found) >= count:
                return found
        raise AssertionError(f"{len(found)} of {count} answers")


JOG = {"arm": "left_arm", "translation": [0.01, 0.0, 0.0]}


def test_an_aim_that_needs_what_is_being_loaded_is_answered_when_it_is_there(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    watched.station.ready()
    loaded: list[bool] = []
    monkeypatch.setattr(watched.station.coordinator.manual._targets, "prepare", lambda: bool(loaded))
    asker = Asker(watched)
    asker.ask("step", jog=JOG)
    asker.ask("pose", pose="home")
    assert [(ack.uuid, ack.status) for ack in asker.answers(1)] == [("pose", "done")]
    asker.ask("again", pose="home")
    assert [ack.uuid for ack in asker.answers(1)] == ["again"]
    loaded.append(True)
    (ack,) = asker.answers(1)
    assert (ack.uuid, ack.status) == ("step", "done")
    assert ack.data["reached"]


def test_of_many_that_wait_for_what_is_being_loaded_some_are_refused(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watched.station.coordinator.manual._targets, "prepare", lambda: False)
    monkeypatch.setattr("runtime.processes.coordinator.process._MOST_WAITING", 10)
    asker = Asker(watched)
    for number in range(13):
        asker.ask(str(number), jog=JOG)
    answers = asker.answers(3)
    assert [(ack.uuid, ack.status) for ack in answers] == [
        (str(number), "refused") for number in (10, 11, 12)
    ]
    assert answers[0].reason == "aim: 10 wait already for what is still being loaded: ask again"
