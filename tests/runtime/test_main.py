"""What main publishes, over real sockets, of a station in lockstep."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq

from runtime.bus import Endpoints, Subscriber
from runtime.main import Service
from tests.runtime.station import DIM, Station, plan

PATIENCE = 500  # times 10 ms


class Watched:
    """A station whose streams a client reads."""

    def __init__(self, folder: Path) -> None:
        self._context: zmq.Context[Any] = zmq.Context()
        self.station = Station(plan(folder))
        self._service = Service(self.station.main, self._context)
        endpoint = Endpoints(self.station.plan.deployment.station_dir).read("main")["state"]
        self._reader = Subscriber(self._context, endpoint, "joints")

    def joints(self) -> dict[str, Any]:
        """The newest joints, of the step that the station is at."""
        step = int(self.station.page.control.read()["step"])
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
    raw = station.main.inference.raw(seen["step"])
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
