"""Whole stations in lockstep whose arms are about to meet: runs, motions by hand, homing, control itself."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.core.clock import VirtualClock
from runtime.core.errors import RuntimeFault
from runtime.core.types import Float64, Observation
from runtime.ipc.messages import ExecutedTick, Order, decode, encode
from runtime.ipc.session_state import SessionState
from runtime.ipc.shared_state import EStop, SharedState
from runtime.processes.control.process import make_tick
from tests.runtime.collision_samples import collisions, turned
from tests.runtime.lockstep_station import Station, stubbed
from tests.runtime.tick_bench import RecordingSink

INWARDS = 0.01  # [rad] per step


def to_and_fro(observation: Observation, number: int) -> Float64:
    """From 0.8 rad inwards to 1.3, and back out."""
    steps = observation.step + np.arange(20)
    return np.array([turned(0.8 + INWARDS * min(step, max(0, 100 - step), 50)) for step in steps])


def run(tmp_path: Path, mode: str, recorded: bool = False) -> Station:
    safety = {"collision": mode, "jump": 1.0}
    recording = {"enabled": recorded}
    made = stubbed(tmp_path, to_and_fro, start=turned(0.8), safety=safety, recording=recording)
    return Station(made).running(130)


@pytest.mark.exhaustive
def test_a_run_whose_arms_meet_goes_on_is_warned_of_once_and_each_tick_says_so_in_the_record(
    tmp_path: Path,
) -> None:
    station = run(tmp_path, "warn", recorded=True)
    assert station.state is SessionState.RUNNING
    (begun,), (over,) = station.events("near"), station.events("near_sum")
    assert "left_arm/" in begun
    assert "actions came too near, nearest: left_arm/" in over
    notes = station.stop().ticks["changes"].to_pylist()
    told = [note for of_tick in notes for note in of_tick if "would" in note]
    assert over.startswith(f"{len(told)} actions")
    deepest = min(collisions()._clearance.distances(q).min() for q in station.robot.sent.astype(float))
    assert deepest < -0.01
    station.close()


def test_where_collisions_are_refused_the_robot_stops_before_it_and_the_run_holds(tmp_path: Path) -> None:
    station = run(tmp_path, "refuse")
    assert station.state is SessionState.HOLDING
    assert "actions refused" in station.reason
    assert "right_arm/" in station.reason
    sent = station.robot.sent.astype(float)
    assert min(collisions()._clearance.distances(q).min() for q in sent) > 0.004
    assert station.events("near") == []
    station.close()


def test_a_motion_by_hand_into_the_other_arm_is_refused_before_anything_moves(tmp_path: Path) -> None:
    station = Station(
        stubbed(tmp_path, start=turned(0.5), run={"mode": "manual"}, recording={"enabled": False})
    ).running(5)
    before = station.robot.position.copy()
    with pytest.raises(RuntimeFault, match=r"move: left_arm/\w+ and right_arm/\w+ would be .* of the way"):
        station.command("move", joints=turned(1.6).tolist())
    station.go(10)
    assert np.allclose(station.robot.position, before, atol=1e-6)
    station.command("move", joints=turned(0.3).tolist())
    station.go(90)
    assert np.allclose(station.robot.position, turned(0.3), atol=1e-3)
    station.close()


def entangled() -> Float64:
    """The left arm is turned over the right one's side: on their straight ways home they meet."""
    q = turned(0.0)
    q[[0, 1, 2]], q[[7, 8, 9]] = (-1.9, 1.9, -1.3), (0.8, 1.8, -0.8)
    assert collisions().nearest(q) is None
    return q


def test_homing_through_the_other_arm_fails_the_set_up_with_what_to_do(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, start=entangled(), setup={"home": True}))
    station.prepare()
    assert station.state is SessionState.IDLE
    assert "going to the pose 'home': left_arm/link" in station.reason
    assert station.reason.endswith("go by another pose, or move the robot by hand first")
    assert np.allclose(station.robot.position, entangled(), atol=1e-6)
    station.close()


def test_homing_by_command_through_the_other_arm_is_refused_and_nothing_changes(tmp_path: Path) -> None:
    station = Station(stubbed(tmp_path, start=entangled())).ready()
    with pytest.raises(RuntimeFault, match="going to the pose 'home': left_arm/link"):
        station.command("home")
    assert station.state is SessionState.READY
    assert np.allclose(station.robot.position, entangled(), atol=1e-6)
    station.close()


def control(
    tmp_path: Path, start: Float64, **safety: Any
) -> tuple[Any, SharedState, RecordingSink, VirtualClock]:
    """Control alone, engaged at `start`."""
    made = stubbed(tmp_path, safety=safety).spec
    shared, _ = SharedState.create(made.layout)
    shared.set_estop(EStop.CLEAR)
    clock, sink = VirtualClock(10.0), RecordingSink()
    return make_tick(made, shared, sink, clock.now), shared, sink, clock


def test_control_itself_stops_a_motion_that_nobody_has_checked(tmp_path: Path) -> None:
    start = turned(0.8)
    tick, shared, sink, clock = control(tmp_path, start, collision="off")
    position, records = start, []
    for step in range(155):
        if step == 5:  # it has been seen for long enough to be taken over
            shared.rings["orders"].push(encode(Order(1, "motion", goal=turned(1.6))))
        for process in ("coordinator", "guard"):
            shared.beat(process, clock.now())
        now = clock.now()
        shared.publish_observation(
            Observation(step + 1, now, {"joints": now}, position.astype(np.float32), {}), {}
        )
        tick(step, now)
        position = sink.sent[-1].astype(float) if sink.sent else start
        records += [m for m in map(decode, shared.rings["ticks"].drain()) if isinstance(m, ExecutedTick)]
        clock.advance(1 / 30)
    assert any(record.refused for record in records)
    assert any("right_arm/" in note for record in records for note in record.notes)
    assert min(collisions()._clearance.distances(q.astype(float)).min() for q in sink.sent) > 0.004
    assert bytes(shared.control.read()["behaviour"]) == b"hold"


@pytest.mark.exhaustive
def test_control_needs_no_compiler(tmp_path: Path) -> None:
    """Numba would cost it 130 MB of locked memory, and half a second at a restart while the robot is told nothing."""
    box = {"left_arm": {"lower": [-2.0] * 3, "upper": [2.0] * 3}}
    program = f"""
import sys
from pathlib import Path
from runtime.processes.control.process import make_tick
from runtime.ipc.shared_state import SharedState
from tests.runtime.lockstep_station import stubbed
from tests.runtime.tick_bench import RecordingSink
made = stubbed(Path({str(tmp_path)!r}), safety={{"workspace": {box!r}}}).spec
shared, _ = SharedState.create(made.layout)
make_tick(made, shared, RecordingSink(), lambda: 0.0)
print("numba" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
