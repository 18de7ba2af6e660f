"""Joints that are missing for a moment: the run stands, and goes on by itself where nothing has changed meanwhile."""

import numpy as np
import pytest

from runtime.ipc.shared_state import EStop
from tests.runtime.compliant import standing
from tests.runtime.tick_bench import PERIOD, Bench, following, wave

STARTED = 10  # ticks of the run before the joints are gone


def gone(seconds, bench=None, rows=None):
    """A run whose joints are not seen for so long; a policy that answers all the time, as `async` asks it to."""
    bench = bench or Bench({"kind": "async"})
    following(bench, wave(200) if rows is None else rows)
    bench.run(STARTED)
    bench.said()
    bench.feed = False
    bench.run(round(seconds / PERIOD))
    bench.feed = True
    return bench


def goes_on(bench):
    """Whether the run executes what the policy answers next."""
    bench.run(8)  # joints are believed again
    at = bench.sent[-1].copy()
    bench.chunk(2, wave(60, start=at[0]))
    bench.run(30)
    return bench.behaviour == "follow" and bool((bench.sent[-1] > at + 0.1).all())


@pytest.mark.parametrize("seconds", [0.3, 0.6, 0.9])
def test_a_run_stands_and_goes_on_by_itself(seconds):
    bench = gone(seconds)
    assert bench.behaviour == "follow"
    assert (bench.sent[-1] == bench.sent[-2]).all() or seconds < 0.5
    assert goes_on(bench)
    kinds = [event.kind for event in bench.said()]
    assert "refusals" not in kinds
    assert "starved" not in kinds


def test_it_says_for_how_long_it_stood():
    bench = gone(0.8)
    bench.run(8)
    assert [event.text for event in bench.said("joints_back")] == [
        "joints again after 0.80 s: the run goes on"
    ]


def test_its_next_chunk_is_blended_in_like_a_first_one():
    bench = gone(0.8)
    bench.run(8)
    at = bench.sent[-1].copy()
    bench.chunk(2, wave(60, start=at[0] + 0.2))
    bench.run(1)
    assert np.abs(bench.sent[-1] - at).max() < 0.05  # not at once where the chunk is
    bench.run(40)
    assert bench.sent[-1] == pytest.approx(at + 0.2 + 40 * 0.5 * PERIOD, abs=1e-6)  # along with it now


def test_what_was_planned_before_is_not_caught_up():
    bench = gone(0.8)
    stood = bench.sent[-1].copy()
    bench.run(30)  # no answer comes: the plan of before would be 0.4 rad farther
    assert bench.sent[-1] == pytest.approx(stood, abs=1e-9)


@pytest.mark.parametrize("seconds", [0.25, 0.3, 0.4, 0.45, 0.5, 0.53])
def test_nor_is_it_after_a_gap_that_ends_before_the_run_waits(seconds):
    bench = gone(seconds, rows=wave(200, 1.0))
    stood = bench.sent[-1].copy()
    bench.run(30)
    assert np.abs(np.diff(bench.sent[-31:], axis=0)).max() <= 1.0 * PERIOD + 1e-9
    assert np.abs(bench.sent[-1] - stood).max() <= 0.06
    assert bench.behaviour == "follow"
    assert goes_on(bench)


def test_a_chunk_far_from_where_it_stands_holds_like_a_first_one():
    bench = gone(0.8)
    bench.run(8)
    bench.chunk(2, wave(60, start=bench.sent[-1][0] + 0.8))
    bench.run(2)
    assert bench.behaviour == "hold"
    assert "safety.jump" in bench.said("too_far")[0].text


def test_joints_that_stay_away_for_longer_hold():
    bench = gone(1.2)
    assert bench.behaviour == "hold"
    assert "actions refused in a row, the last one: joint readings are 1.0" in bench.said("refusals")[0].text
    assert not goes_on(bench)


def test_joints_that_keep_coming_but_are_old_hold_too():
    bench = gone(0.3)
    bench.feed = False
    for _ in range(60):
        now = bench.clock.now()
        bench.observe(captured={"joints": now - 0.3, "cam": now})
        bench.run(1)
    assert bench.behaviour == "hold"
    assert not goes_on(bench)


def test_a_control_that_itself_did_not_look_for_longer_holds():
    bench = Bench({"kind": "async"}, refusals_to_hold=3)
    gone(0.35, bench)
    bench.clock.advance(3.0)
    bench.run(1)
    assert bench.behaviour == "hold"


def test_the_third_gap_in_ten_seconds_holds():
    bench = gone(0.8)
    for _ in range(2):
        assert goes_on(bench)
        bench.chunk(3, wave(200, start=bench.sent[-1][0]))
        bench.run(STARTED)
        bench.feed = False
        bench.run(round(0.8 / PERIOD))
        bench.feed = True
    assert bench.behaviour == "hold"
    assert "actions refused" in bench.said("refusals")[0].text


def test_two_gaps_and_one_much_later_do_not():
    bench = gone(0.8)
    for _ in range(2):
        assert goes_on(bench)
        for _ in range(round(10.0 / PERIOD / 30)):
            bench.chunk(3, wave(200, start=bench.sent[-1][0], speed=0.01))
            bench.run(30)
        bench.feed = False
        bench.run(round(0.8 / PERIOD))
        bench.feed = True
    assert goes_on(bench)


def test_joints_that_are_nowhere_when_they_are_back_hold():
    bench = gone(0.8)
    bench.feed = False
    for _ in range(12):
        bench.observe(qpos=np.full(2, np.nan, np.float32))
        bench.run(1)
    assert not goes_on(bench)


def test_the_bound_is_a_key():
    bench = gone(0.8, Bench({"kind": "async"}, joint_gap_s=0.3))
    assert bench.behaviour == "hold"
    assert bench.said("refusals")[0].text.startswith("10 actions refused in a row")


def test_an_arm_that_comes_back_elsewhere_holds():
    bench = gone(0.8)
    bench.moved_by_hand = bench.sent[-1] + np.array([0.0, 0.15])
    bench.measured = bench.moved_by_hand
    assert not goes_on(bench)
    assert bench.behaviour == "hold"


def test_an_arm_that_comes_back_before_half_a_second_elsewhere_holds_too():
    bench = gone(0.55)  # 10 refusals are over
    bench.moved_by_hand = bench.sent[-1] + np.array([0.0, 0.15])
    bench.measured = bench.moved_by_hand
    assert not goes_on(bench)
    assert bench.behaviour == "hold"


def test_joints_that_contradict_themselves_when_they_are_back_hold():
    bench = gone(0.8)
    stood = bench.sent[-1].copy()
    for tick in range(30):
        bench.moved_by_hand = stood + (0.3 if tick % 2 else -0.3)
        bench.measured = bench.moved_by_hand
        bench.run(1)
    assert bench.behaviour == "hold"
    assert np.abs(bench.sent - stood).max() < 0.3


def test_refusals_for_other_reasons_among_them_hold():
    rows = wave(200)
    rows[STARTED + 2 : STARTED + 6] = 1.9  # a jump
    bench = gone(0.8, rows=rows)
    assert bench.behaviour == "hold"


def test_a_plan_that_ends_meanwhile_is_no_starvation():
    bench = gone(0.8, rows=wave(STARTED + 9))
    assert bench.behaviour == "follow"
    assert goes_on(bench)


def test_an_e_stop_meanwhile_is_obeyed_and_ends_the_run():
    bench = Bench({"kind": "async"})
    gone(0.6, bench)
    bench.feed = False
    bench.run(1)
    bench.shared.set_estop(EStop.LATCHED)
    bench.run(1)
    assert bench.behaviour == "estop"
    bench.shared.set_estop(EStop.CLEAR)
    bench.feed = True
    assert not goes_on(bench)


def test_a_motion_of_ours_is_held_as_before():
    bench = Bench({"kind": "async"})
    bench.say("motion", goal=np.ones(2))
    bench.run(STARTED)
    bench.feed = False
    bench.run(20)
    assert bench.behaviour == "hold"
    assert bench.said("refusals")[0].text.startswith("10 actions refused in a row")


@pytest.mark.parametrize("seconds", [0.2, 0.3, 0.45])
@pytest.mark.parametrize("speed", [0.8, 1.5])
def test_an_e_stop_that_is_pressed_in_a_gap_drives_nothing_back(speed, seconds):
    """What was seen before the gap says where the arm was, and not where it is."""
    bench = standing(0.0)
    following(bench, wave(300, speed))
    bench.seconds(1.0)
    bench.feed = False
    bench.seconds(seconds)
    bench.stop().seconds(0.1)
    bench.feed = True
    before = len(bench.course)
    bench.seconds(2.0)
    course = np.array(bench.course[before:])
    back = np.maximum.accumulate(course, axis=0) - course
    assert back.max() < 0.06
    assert np.abs(np.diff(bench.sent[-30:], axis=0)).max() < 1e-6  # it stands


def test_an_e_stop_without_a_gap_is_obeyed_by_what_is_seen_just_now():
    bench = standing(0.0)
    following(bench, wave(300, 1.0))
    bench.seconds(1.0)
    at = bench.true.copy()
    bench.stop().seconds(2.0)
    assert (bench.true - at).max() < 0.12
