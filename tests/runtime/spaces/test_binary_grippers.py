from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import robots
from runtime.core.types import ActionChunk
from runtime.ipc.shared_state import EStop
from runtime.motion.timeline import DimensionKinds
from runtime.policies.base import PolicyInfo
from runtime.safety.limits import Limits
from runtime.spaces.binary_grippers import MIN_SWITCH_INTERVAL_S, BinaryGripper, Dwell, binary_grippers_of
from tests.examples import some
from tests.runtime.lockstep_station import Station, Stubs, stubbed
from tests.runtime.tick_bench import PERIOD, WITH_GRIPPER, Bench

PERCENT = BinaryGripper(6, 100.0, 0.0, 80.0, 5.0)  # an R1 Lite's
ANGLE = BinaryGripper(7, -0.785, 0.0, -0.4, 0.04)  # open is the smaller number, as with a G2
KINDS = ("sync", "async", "ensemble", "naive", "rtc")


# --- what a number means ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("switch", "before", "wanted", "meant"),
    [
        (PERCENT, 0.0, [37, 79, 81, 99, 81, 79, 77], [0, 0, 0, 100, 100, 100, 0]),
        (PERCENT, 100.0, [79, 81, 77.4, 82.4, 82.6], [100, 100, 0, 0, 100]),
        (PERCENT, 37.0, [80], [0]),  # where it was measured when it was taken over
        (ANGLE, 0.0, [-0.41, -0.43, -0.39, -0.37], [0, -0.785, -0.785, 0]),
        (replace(PERCENT, hysteresis=0.0), 0.0, [79.9, 80, 79.9], [0, 100, 0]),
        (replace(PERCENT, hysteresis=40.0), 0.0, [99, 100, 61, 60], [0, 100, 100, 0]),
    ],
)
def test_a_number_is_open_or_closed_and_near_the_threshold_what_it_was(
    switch: BinaryGripper, before: float, wanted: list[float], meant: list[float]
) -> None:
    assert switch.snap_sequence(np.array(wanted, np.float64), before).tolist() == meant


numbers = st.lists(st.floats(-50, 150), min_size=1, max_size=30)


@given(numbers, st.floats(0, 100), st.integers(0, 30), st.booleans())
def test_it_is_the_same_number_by_number_and_in_either_direction(
    wanted: list[float], before: float, part: int, mirrored: bool
) -> None:
    rows = np.array(wanted)
    whole = PERCENT.snap_sequence(rows, before)
    state, expected = before >= 80, []
    for number in wanted:
        state = number >= 82.5 if abs(number - 80) >= 2.5 else state
        expected.append(100.0 if state else 0.0)
    assert whole.tolist() == expected
    first = PERCENT.snap_sequence(rows[:part], before)
    rest = PERCENT.snap_sequence(rows[part:], first[-1] if len(first) else before)
    assert [*first, *rest] == whole.tolist()
    if mirrored:
        other = BinaryGripper(0, 0.0, 100.0, 20.0, 5.0).snap_sequence(100.0 - rows, 100.0 - before)
        assert (100.0 - other).tolist() == whole.tolist() or abs(before - 80) < 1e-9


def test_every_binary_gripper_of_a_robot_is_one() -> None:
    robot = robots.load_robot("r1_lite")
    assert [
        (one.dim, one.open, one.close, one.threshold, one.hysteresis) for one in binary_grippers_of(robot)
    ] == [
        (6, 100.0, 0.0, 80.0, 5.0),
        (13, 100.0, 0.0, 80.0, 5.0),
    ]
    assert binary_grippers_of(robots.load_robot("agilex_piper")) == ()


def test_the_hysteresis_is_the_deployments_where_it_says_so(tmp_path: Path) -> None:
    table = {"left_arm": {"binary": True, "threshold": 0.05, "hysteresis": 0.5}}
    (only,) = binary_grippers_of(stubbed(tmp_path, grippers=table).spec.robot)
    assert only.snap_sequence(np.array([0.06, 0.074, 0.076, 0.03, 0.02]), 0.0).tolist() == [0, 0, 0.1, 0.1, 0]


# --- how often it switches ---------------------------------------------------------------------------------------


BINARY = Limits(
    ("a", "b", "gripper"),
    WITH_GRIPPER.lower,
    WITH_GRIPPER.upper,
    WITH_GRIPPER.velocity,
    WITH_GRIPPER.grippers,
    WITH_GRIPPER.grippers,
)


def test_a_gripper_that_has_just_switched_is_kept_and_a_continuous_one_is_not() -> None:
    closed, opened = np.zeros(3), np.array([0.5, 0.0, 0.1])
    for limits, kept in ((BINARY, True), (WITH_GRIPPER, False)):
        dwell = Dwell(limits)
        assert dwell.apply(opened, closed, 10.0) == (opened, ())
        dwell.record_command(closed, opened, 10.0)
        action, notes = dwell.apply(closed, opened, 10.0 + MIN_SWITCH_INTERVAL_S / 2)
        assert action.tolist() == ([0.0, 0.0, 0.1] if kept else [0.0, 0.0, 0.0])
        assert notes == (("gripper kept at 0.1: it switches once per 0.2 s at most",) if kept else ())
        assert dwell.apply(closed, opened, 10.0 + MIN_SWITCH_INTERVAL_S)[1] == ()


HALF = BinaryGripper(2, 0.1, 0.0, 0.05, 0.005)


def switched_at(sent: np.ndarray) -> np.ndarray:
    """The ticks at which a gripper was told another number than at the tick before."""
    return np.flatnonzero(np.abs(np.diff(sent)) > 1e-6) + 1


chunk_of = st.tuples(
    st.integers(0, 6),  # ticks before it
    st.lists(st.sampled_from([0.0, 0.1]), min_size=1, max_size=12),
    st.sampled_from(["chunk", "move", "lock", "unlock", "hold"]),
)


@settings(max_examples=some(60))
@given(st.sampled_from(KINDS), st.lists(chunk_of, min_size=1, max_size=12))
def test_what_is_sent_switches_in_one_tick_and_rests_whatever_is_asked_for(
    kind: str, course: list[tuple[int, list[float], str]]
) -> None:
    bench = Bench({"kind": kind}, limits=BINARY, dims=DimensionKinds(switched=(2,)), switches=(HALF,))
    bench.say("follow", run=1)
    for number, (ticks, grippers, what) in enumerate(course, 1):
        bench.run(ticks)
        rows = np.zeros((len(grippers), 3))
        rows[:, 2] = grippers
        if what == "chunk":
            bench.chunk(number, rows, waited=kind == "sync")
        elif what == "move":
            bench.say("motion", run=1, goal=np.array([0.1, np.nan, 0.037 + grippers[0] / 2]))
        elif what == "hold":
            bench.say("hold", run=1)
            bench.say("follow", run=1)
        else:
            bench.lock(np.nan, np.nan, np.nan if what == "unlock" else grippers[0])
    bench.run(20)
    told = bench.sent[:, 2]
    assert set(np.round(told, 6)) <= {0.0, 0.1}
    assert (np.diff(switched_at(told)) >= round(MIN_SWITCH_INTERVAL_S / PERIOD)).all()


def test_a_switch_that_came_too_soon_is_made_when_the_time_is_over_and_noted() -> None:
    bench = Bench(limits=BINARY, dims=DimensionKinds(switched=(2,)))
    rows = np.zeros((30, 3))
    rows[5:7, 2] = rows[8:, 2] = 0.1
    bench.say("follow", run=1)
    bench.chunk(1, rows)
    bench.run(30)
    assert switched_at(bench.sent[:, 2]).tolist() == [5]
    rows[:, 2] = 0.1
    rows[3:, 2] = 0.0
    bench.chunk(2, rows)
    bench.run(2)
    rows[:, 2] = 0.1
    bench.chunk(3, rows[:1])
    bench.run(28)
    assert "gripper kept at 0.1: it switches once per 0.2 s at most" in {
        note for record in bench.records() for note in record.notes
    }


@pytest.mark.parametrize(("wanted", "told"), [(0.037, 0.0), (0.051, 0.0), (0.06, 0.1), (0.1, 0.1)])
def test_a_motion_by_hand_switches_it_in_its_first_tick(wanted: float, told: float) -> None:
    bench = Bench(limits=BINARY, switches=(HALF,))
    bench.say("motion", goal=np.array([0.5, 0.0, wanted]))
    bench.run(200)
    assert bench.sent[1, 2] == pytest.approx(told)
    assert np.unique(bench.sent[1:, 2]).tolist() == pytest.approx([told])
    assert [event.kind for event in bench.said()] == ["motion_done"]


anything = st.one_of(st.sampled_from([0.0, 0.1]), st.floats(-0.05, 0.15))
order = st.tuples(
    st.sampled_from(["chunk", "motion", "lock", "unlock", "hold", "sim", "estop", "clear", "restart"]),
    anything,
    st.integers(1, 9),  # ticks after it
)


@settings(max_examples=some(60))
@given(anything, st.lists(order, min_size=1, max_size=15))
def test_whatever_control_is_ordered_it_sends_open_or_closed(
    stood: float, course: list[tuple[str, float, int]]
) -> None:
    """Rows, goals and locks as nobody in the coordinator would write them, of a robot that is taken over half open."""
    bench = Bench(limits=BINARY, dims=DimensionKinds(switched=(2,)), switches=(HALF,))
    bench.measured = np.array([0.0, 0.0, stood])
    bench.say("follow", run=1)
    bench.run(3)
    for number, (kind, value, ticks) in enumerate(course, 1):
        if kind == "chunk":
            bench.chunk(number, np.tile([0.0, 0.0, value], (20, 1)))
        elif kind == "motion":
            bench.say("motion", run=1, goal=np.array([0.1, np.nan, value]))
        elif kind in ("lock", "unlock"):
            bench.lock(np.nan, np.nan, value if kind == "lock" else np.nan)
        elif kind in ("hold", "sim"):
            bench.say("hold" if kind == "hold" else "follow", run=1, mode="sim" if kind == "sim" else None)
        elif kind == "restart":
            bench.tick = bench.new_tick()
        else:
            bench.shared.set_estop(EStop.LATCHED if kind == "estop" else EStop.CLEAR)
        bench.run(ticks)
        told = np.array([bench.status[name][2] for name in ("locked", "simulated")], np.float64)
        assert set(np.round(told[~np.isnan(told)], 6)) <= {0.0, 0.1}
    assert set(np.round(bench.sent[:, 2], 6)) <= {0.0, 0.1}


@pytest.mark.parametrize(("stood", "told"), [(0.037, 0.0), (0.06, 0.1)])
def test_an_e_stop_that_takes_a_robot_over_moves_no_gripper_and_the_next_order_switches_it(
    stood: float, told: float
) -> None:
    bench = Bench(limits=BINARY, switches=(HALF,))
    bench.measured = np.array([0.2, 0.0, stood])
    bench.shared.set_estop(EStop.LATCHED)
    bench.run(5)
    bench.shared.set_estop(EStop.CLEAR)
    bench.run(5)
    assert bench.sent[:, 2] == pytest.approx(stood)
    begun = len(bench.sent)
    bench.say("motion", goal=np.array([0.3, np.nan, np.nan]))
    bench.run(5)
    assert bench.sent[begun:, 2] == pytest.approx(told)


# --- whole stations ------------------------------------------------------------------------------------------------


class Rtc:
    """Says that it continues chunks, so that every strategy can be set up."""

    def __init__(self, station: Station) -> None:
        station.policy.connect = lambda: PolicyInfo("stub", supports_rtc=True)  # type: ignore[method-assign]


def r1_lite(tmp_path: Path, kind: str, told: list[float], **more: Any) -> tuple[Stubs, np.ndarray]:
    home = robots.load_robot("r1_lite").poses["home"].copy()
    home[[6, 13]] = 0.0

    def rows(seen: Any, number: int) -> np.ndarray:
        made = np.tile(home, (20, 1))
        made[:, 6] = np.take(told, np.arange(seen.step, seen.step + 20) // 10, mode="clip")
        made[:, 13] = 37.0
        return made

    return stubbed(tmp_path, rows, kind, robot="r1_lite", start=home, delay=2, **more), home


@pytest.mark.some(1)
@pytest.mark.parametrize(
    ("kind", "rate"),
    [
        ("sync", None),
        *((kind, None) for kind in KINDS[1:]),
        *(
            pytest.param(kind, rate, marks=pytest.mark.exhaustive)
            for kind in KINDS[1:]
            for rate in (12.0, 50.0)
        ),
    ],
)
def test_an_r1_lite_is_told_open_or_closed_under_every_strategy(
    tmp_path: Path, kind: str, rate: float | None
) -> None:
    made, _ = r1_lite(tmp_path, kind, [37.0, 79.0, 81.0, 99.0, 81.0, 79.0, 37.0, 99.0])
    station = Station(made)
    Rtc(station)
    asked, infer = [], station.policy.infer

    def infer_at(observation: Any, conditioning: Any = None) -> ActionChunk:
        asked.append(conditioning)
        return replace(infer(observation, conditioning), rate=rate)

    station.policy.infer = infer_at  # type: ignore[method-assign]
    station.running(140)
    sent = station.robot.sent
    assert set(np.unique(sent[:, 6])) == {0.0, 100.0}
    assert set(np.unique(sent[:, 13])) == {0.0}
    assert len(switched_at(sent[:, 6])) == 3
    episode = station.stop()
    raw = np.array([row["action"] for row in episode.raw.to_pylist()])
    assert {37.0, 79.0, 81.0, 99.0} <= set(raw[:, 6].tolist())  # as the server gave them
    if kind == "rtc":
        prefixes = np.concatenate([given.previous[:, 6] for given in asked if given is not None])
        assert {37.0, 99.0} <= set(prefixes.tolist()) <= {37.0, 79.0, 81.0, 99.0}
    station.close()


@pytest.mark.some(1)
@pytest.mark.parametrize("kind", ["sync", "async", "ensemble", "naive"])
def test_a_continuous_gripper_is_told_what_the_policy_says(tmp_path: Path, kind: str) -> None:
    made, _ = r1_lite(
        tmp_path,
        kind,
        [37.0, 79.0, 81.0, 99.0],
        grippers={name: {"binary": False} for name in ("left_arm", "right_arm")},
    )
    station = Station(made).running(80)
    assert {37.0, 79.0, 81.0, 99.0} <= set(station.robot.sent[:, 6].round(3).tolist())
    station.close()


def test_between_chunks_it_stays_what_it_was_last_told(tmp_path: Path) -> None:
    made, _ = r1_lite(tmp_path, "sync", [99.0, *[79.0] * 30])
    station = Station(made).running(100)
    assert switched_at(station.robot.sent[:, 6]).size == 1
    assert station.robot.sent[-1, 6] == 100.0
    station.close()
