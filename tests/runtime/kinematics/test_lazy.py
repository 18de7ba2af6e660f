from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest

import robots
from runtime.core.errors import SetupError
from runtime.kinematics import compiled
from runtime.kinematics.base import ChainForward, Kinematics
from runtime.kinematics.lazy import LazyKinematics
from runtime.processes.coordinator.inference.runners import LockstepRunner, ThreadRunner
from tests.processes import PATIENCE_S, joined
from tests.runtime.lockstep_station import Station, stubbed

ROBOT = robots.load_robot("ur5e")
Q = ROBOT.poses["home"]


def made() -> Kinematics:
    return compiled.build(compiled.Config(), ROBOT)


class Aside:
    """What is to be made is made when the test says so."""

    def __init__(self) -> None:
        self.calls: list[tuple[Future[Kinematics], Callable[[], Kinematics]]] = []

    def __call__(self, call: Callable[[], Kinematics]) -> Future[Kinematics]:
        future: Future[Kinematics] = Future()
        self.calls.append((future, call))
        return future

    def do(self) -> None:
        ((future, call),) = self.calls
        try:
            future.set_result(call())
        except Exception as error:
            future.set_exception(error)


def test_nothing_is_made_for_joints_that_become_poses() -> None:
    aside = Aside()
    loading = LazyKinematics(ChainForward(ROBOT), made, aside)
    assert np.array_equal(loading.forward(Q), ChainForward(ROBOT).forward(Q))
    assert aside.calls == []


def test_it_is_made_once_and_until_then_nobody_who_goes_forward_waits() -> None:
    aside = Aside()
    loading = LazyKinematics(ChainForward(ROBOT), made, aside)
    assert not loading.prepare()
    assert not loading.prepare()
    assert np.array_equal(loading.forward(Q), ChainForward(ROBOT).forward(Q))
    aside.do()
    assert loading.prepare()
    assert len(aside.calls) == 1
    assert np.array_equal(loading.forward(Q), made().forward(Q))


def test_both_ways_forward_are_the_same() -> None:
    rows = np.linspace(Q, Q + 0.4, 20)
    assert np.allclose(ChainForward(ROBOT).forward(rows), made().forward(rows), atol=1e-12)


def test_who_solves_waits_for_it_and_gets_what_the_backend_says() -> None:
    gate = threading.Event()

    def slowly() -> Kinematics:
        assert gate.wait(PATIENCE_S)
        return made()

    loading = LazyKinematics(ChainForward(ROBOT), slowly, ThreadRunner().run_in_background)
    targets = loading.forward(Q)[None]
    found: list[np.ndarray] = []
    solving = threading.Thread(target=lambda: found.append(loading.solve(targets, Q, 0.1, Q, 0).q))
    solving.start()
    assert found == []
    gate.set()
    joined(solving)
    assert np.array_equal(found[0], made().solve(targets, Q, 0.1, Q, 0).q)
    assert loading.prepare()


def test_in_lockstep_it_is_made_at_once() -> None:
    loading = LazyKinematics(ChainForward(ROBOT), made, LockstepRunner(3).run_in_background)
    assert loading.prepare()


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (SetupError("numba is not installed"), "numba is not installed"),
        (OSError("no room"), "kinematics cannot be created: OSError: no room"),
    ],
)
def test_what_cannot_be_made_is_said_to_who_solves_and_forward_goes_on(error: Exception, said: str) -> None:
    def broken() -> Kinematics:
        raise error

    loading = LazyKinematics(ChainForward(ROBOT), broken, LockstepRunner(0).run_in_background)
    assert loading.prepare()
    with pytest.raises(SetupError, match=said):
        loading.solve(loading.forward(Q)[None], Q)
    assert np.array_equal(loading.forward(Q), ChainForward(ROBOT).forward(Q))


def test_a_station_with_a_policy_of_joints_loads_no_compiler(tmp_path: Path) -> None:
    """In a process of its own: this one has loaded it."""
    script = (
        "import sys; from pathlib import Path; from tests.runtime.lockstep_station import Station, stubbed\n"
        f"station = Station(stubbed(Path({str(tmp_path)!r}))).running(30)\n"
        "assert station.coordinator.spaces.eef_of(station.coordinator.manual.commanded()).shape == (16,)\n"
        "assert 'numba' not in sys.modules, 'loaded'\n"
        "station._handle('aim', {'jog': {'arm': 'left_arm', 'translation': [0.01, 0, 0]}})\n"
        "assert 'numba' in sys.modules, 'not loaded'\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-1500:]


def test_a_run_by_hand_begins_when_steps_can_be_answered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    station = Station(stubbed(tmp_path)).ready()
    loaded: list[bool] = []
    monkeypatch.setattr(station.coordinator.runs, "_prepared", lambda: bool(loaded))
    station.command("run", mode="manual")
    station.go(30)
    assert station.coordinator.run is not None
    assert station.coordinator.run.begun_at is None
    assert station._handle("move", {"pose": "ready"}).status == "refused"
    station.command("halt")
    loaded.append(True)
    station.go(10)
    assert station.coordinator.run.begun_at is None, "who has halted it has not resumed it"
    station.command("resume")
    station.go(3)
    assert station.coordinator.run.begun_at is not None
    station.stop()
    loaded.clear()
    station.command("run", mode="manual")
    station.go(30)
    loaded.append(True)
    station.go(3)
    assert station.coordinator.run.begun_at is not None
    station.command("stop")
    station.go(3)
    loaded.clear()
    station.command("run")
    station.go(10)
    assert station.coordinator.run.begun_at is not None, "a policy's run needs none of it"
    station.close()
