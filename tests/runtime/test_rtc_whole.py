"""Real-time chunking through the assembled runtime: strategy, commitment, a dialect on a real socket, the record."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from runtime.plugins import variants
from runtime.sim.openpi_server import Behaviour, OpenpiServer
from runtime.sim.script import Answer, Script
from runtime.transitions import State
from runtime.types import Float32, Float64, UInt8
from tests.runtime.station import MOVED, STANDS, Station, StubPlan, column, plan

HORIZON, DELAY = 16, 4


class Wavering(Script):
    """Changes its mind with every answer: the same pose, to one side and to the other."""

    metadata: Mapping[str, object] = {"name": "wavering", "action_horizon": HORIZON}

    def begin(self) -> Answer:
        side = itertools.cycle((-0.04, 0.04))

        def answer(q: Float64, pictures: Mapping[str, UInt8], prompt: str) -> Float32:
            rows = np.tile(STANDS, (HORIZON, 1)).astype(np.float32)
            rows[:, MOVED] += next(side)
            return rows

        return answer


class WiredPlan(StubPlan):
    """The stub robot, with the policy of the deployment."""

    @property
    def policy(self) -> Any:
        return SimpleNamespace(build=self._wired)

    def _wired(self, *given: Any) -> Any:
        made = variants("runtime.policies")["openpi"].build(*given)
        self.built["policy"] = made
        self.built.setdefault("policies", []).append(made)
        return made


@contextlib.contextmanager
def wired(tmp_path: Path, dialect: str, strategy: str, served: str = "") -> Iterator[Station]:
    bare = plan(tmp_path)
    server = OpenpiServer(bare.robot, Behaviour(HORIZON, 30.0, rtc=served or dialect), 0, Wavering())
    with contextlib.closing(server):
        made = plan(
            tmp_path,
            strategy=strategy,
            delay=DELAY,
            policy={"kind": "openpi", "url": server.start()["url"], "rtc": dialect, "image_size": [16, 16]},
        )
        parts = {name: getattr(made, name) for name in StubPlan.__slots__}
        station = Station(WiredPlan(made.resolved, made.robot, **parts))
        yield station
        station.close()


def chunks(station: Station) -> list[tuple[int, np.ndarray]]:
    """(observation step, rows [H, D]) of every chunk that was merged."""
    raw = station.stop().raw
    steps, actions = column(raw, "observation_step"), column(raw, "action")
    assert len(actions) % HORIZON == 0
    return [(int(steps[at]), actions[at : at + HORIZON]) for at in range(0, len(actions), HORIZON)]


def seams(station: Station) -> np.ndarray:
    """How far each chunk is, at the step it arrived, from what the one before it wanted then [rad]."""
    found = chunks(station)
    assert len(found) > 8
    return np.array(
        [
            np.abs(new[DELAY] - old[step - before + DELAY]).max()
            for (before, old), (step, new) in itertools.pairwise(found)
            if step - before + DELAY < HORIZON
        ]
    )


@pytest.mark.parametrize("dialect", ["prev_action", "async_rtc"])
def test_a_chunk_continues_what_the_robot_is_committed_to_whatever_the_policy_would_rather(
    tmp_path: Path, dialect: str
) -> None:
    with wired(tmp_path, dialect, "rtc") as station:
        station.running(90)
        assert station.state is State.RUNNING, station.reason
        told = station.main.snapshot()["policy"]["rtc"]
        assert (told["conditioned"], told["predicted_delay"]) == (True, DELAY)
        assert seams(station).max() < 0.015  # of the 0.08 that it wavers


def test_without_it_the_same_policy_wavers(tmp_path: Path) -> None:
    with wired(tmp_path, "prev_action", "async") as station:
        station.running(90)
        assert np.median(seams(station)) == pytest.approx(0.08, abs=1e-3)


def test_a_policy_that_does_not_speak_it_is_refused_at_set_up_and_when_it_is_tuned_to(tmp_path: Path) -> None:
    with wired(tmp_path, "none", "rtc") as station:
        station.prepare()
        assert station.state is State.IDLE
        assert "does not continue a chunk" in station.reason
    with wired(tmp_path, "none", "async") as station:
        station.running(10)
        with pytest.raises(Exception, match="does not continue a chunk"):
            station.command("tune", strategy={"kind": "rtc"})
        station.go(10)
        assert station.state is State.RUNNING
