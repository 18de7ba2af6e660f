"""Simulated runs, motions at a speed, and the sentences about what safety did: a lane as the tick drives it."""

import numpy as np
import pytest

from runtime.ipc.messages import ExecutedTick, decode
from runtime.ipc.shared_state import EStop
from tests.runtime.tick_bench import PERIOD, Bench, following, wave


@pytest.fixture
def bench():
    return Bench()


def simulating(bench, rows=None, engaged=False):
    """A run in simulation, one tick old; `engaged`: the robot was held before."""
    if engaged:
        bench.say("motion", goal=np.zeros(2))
        bench.run(3)
        bench.records()
        bench.said()
    return following(bench, rows, mode="sim")


def simulated(bench):
    return bench.status["simulated"].astype(float)


# --- simulation ---------------------------------------------------------------------------------------------


def test_a_robot_that_is_not_ours_is_told_nothing_during_a_simulation(bench):
    simulating(bench)
    bench.run(20)
    assert bench.sink.sent == []
    assert not bench.status["engaged"]
    assert bench.behaviour == "simulate"
    assert np.allclose(simulated(bench), wave(21)[20], atol=1e-6)


def test_a_robot_that_is_held_goes_on_being_held_during_a_simulation(bench):
    simulating(bench, engaged=True)
    bench.run(20)
    assert len(bench.sent) == 3 + 21
    assert (bench.sent == bench.sent[0]).all()
    assert np.allclose(simulated(bench), wave(21)[20], atol=1e-6)
    assert bench.status["commanded"].tolist() == [0.0, 0.0]


def test_the_record_of_a_simulation_is_that_of_the_simulated_robot(bench):
    simulating(bench)
    bench.run(9)
    records = bench.records()
    assert {record.source for record in records} == {"sim"}
    assert np.allclose([record.executed for record in records], wave(10), atol=1e-6)
    assert [record.chunk_ids for record in records] == [[1]] * 10
    assert records[-1].qpos.tolist() == [0.0, 0.0]


def test_a_simulation_starts_where_the_robot_is_measured(bench):
    bench.measured = np.array([0.7, -0.4])
    bench.say("follow", run=1, mode="sim")
    bench.run()
    assert simulated(bench) == pytest.approx([0.7, -0.4])


def test_without_joints_nobody_knows_where_a_simulation_is_to_begin():
    bench = Bench(seen=False)
    bench.feed = False
    bench.say("follow", run=1, mode="sim")
    bench.run(2)
    assert "start pose of the simulation is unknown" in bench.said("unmeasured")[0].text
    assert np.isnan(simulated(bench)).all()
    assert bench.records()[-1].source == "none"


def test_a_simulation_does_not_wait_for_an_arm_that_is_blocked_or_silent(bench):
    bench.moved_by_hand = np.zeros(2)
    simulating(bench, wave(60, speed=1.0))
    bench.run(30)
    assert simulated(bench)[0] == pytest.approx(1.0, abs=1e-5)  # farther than the following error allows
    assert bench.said() == []


def test_limits_hold_for_a_simulated_robot(bench):
    simulating(bench, wave(10, speed=0.5))
    bench.run(4)
    bench.chunk(2, np.full((40, 2), 0.5), step=bench.step)
    bench.chunk(3, wave(60, speed=9.0))
    bench.run(30)
    path = np.array([record.executed[0] for record in bench.records()])
    speed = np.diff(path) / PERIOD
    assert np.abs(speed).max() <= 3.0 + 1e-4
    assert np.abs(np.diff(speed)).max() <= 60.0 * PERIOD + 1e-3


def test_a_jump_is_refused_in_simulation_as_on_the_robot(bench):
    simulating(bench, np.vstack([wave(3), np.full((40, 2), 1.9)]))
    bench.run(20)
    assert [event.kind for event in bench.said()] == ["refused", "refusals"]
    assert bench.behaviour == "silent"
    assert bench.sink.sent == []


def test_a_simulation_starves_and_recovers_as_a_run_on_the_robot_does(bench):
    simulating(bench, wave(5))
    bench.run(8)
    assert bench.status["starved"]
    bench.chunk(2, wave(60, start=simulated(bench)[0]))
    bench.run(5)
    assert [event.kind for event in bench.said()] == ["starved", "recovered"]
    bench.run(90)
    assert bench.said("starvation")
    assert bench.sink.sent == []


def test_pictures_that_are_old_refuse_a_simulated_action_too(bench):
    simulating(bench, wave(90))
    bench.feed = False
    bench.run(40)
    assert "picture cam" in bench.said("refusals")[0].text


def test_a_hold_order_stops_a_simulation_and_the_same_run_goes_on_from_there(bench):
    simulating(bench, wave(60, speed=1.5))
    bench.run(9)
    bench.say("hold", run=1)
    bench.run(20)
    stood = simulated(bench)
    assert stood[0] > wave(11, 1.5)[9, 0]  # it came to a stand, it did not freeze
    assert {record.source for record in bench.records()[-15:]} == {"hold"}
    bench.say("follow", run=1, mode="sim")
    bench.chunk(2, wave(60, start=stood[0]))
    bench.run()
    assert simulated(bench) == pytest.approx(stood, abs=1e-6)
    assert bench.sink.sent == []


def test_a_hold_outside_the_run_ends_the_simulated_robot(bench):
    simulating(bench)
    bench.run(9)
    bench.say("hold", run=0)
    bench.run()
    assert np.isnan(simulated(bench)).all()


def test_another_run_starts_anew_where_the_robot_is(bench):
    simulating(bench)
    bench.run(20)
    bench.say("hold", run=1)
    bench.run(5)
    bench.say("follow", run=2, mode="sim")
    bench.run()
    assert simulated(bench).tolist() == [0.0, 0.0]


def test_the_e_stop_ends_a_simulation(bench):
    simulating(bench, engaged=True)
    bench.run(9)
    bench.shared.set_estop(EStop.LATCHED)
    bench.run(3)
    assert np.isnan(simulated(bench)).all()
    assert bench.behaviour == "estop"
    assert {record.source for record in bench.records()[-3:]} == {"estop"}
    bench.shared.set_estop(EStop.CLEAR)
    bench.run(5)
    assert np.isnan(simulated(bench)).all()


def test_a_dead_main_ends_a_simulation(bench):
    simulating(bench, wave(90))
    bench.alive = False
    bench.run(40)
    assert "coordinator" in bench.said("family")[0].text
    stood = simulated(bench)
    bench.run(5)
    assert (simulated(bench) == stood).all()


def test_a_run_on_the_robot_after_a_simulation_starts_where_the_robot_is(bench):
    simulating(bench)
    bench.run(30)
    following(bench, wave(60), mode="continuous")
    bench.run(3)
    assert np.allclose(bench.sent, wave(4), atol=1e-6)
    assert np.isnan(simulated(bench)).all()
    assert bench.behaviour == "follow"


def test_a_simulation_that_begins_while_the_robot_moves_brings_it_to_a_stand(bench):
    following(bench, wave(60, speed=1.5))
    bench.run(9)
    bench.say("follow", run=2, mode="sim")
    bench.run(20)
    steps = np.diff(bench.sent[9:, 0])
    assert (np.diff(steps) <= 1e-6).all()
    assert steps[-1] == 0


# --- motions ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("speed", [1.0, 0.5, 0.1])
def test_a_motion_uses_that_part_of_the_speed_of_motions(bench, speed):
    bench.say("motion", goal=np.array([0.8, 0.0]), speed=speed)
    bench.run(300)
    top = 3.0 * 0.3 * speed
    reached = np.diff(bench.sent[:, 0]).max() / PERIOD
    assert 0.95 * top <= reached <= 1.06 * top
    assert bench.said("motion_done")


@pytest.mark.parametrize("order", [{"speed": 0.0}, {"speed": 1.5}, {"speed": float("nan")}, {"speed": -1.0}])
def test_a_motion_at_an_impossible_speed_is_refused_and_held(bench, order):
    following(bench, wave(60))
    bench.say("motion", goal=np.ones(2), **order)
    bench.run(20)
    assert "of its speed; allowed: above 0 up to 1" in bench.said("refusals")[0].text
    assert bench.behaviour == "hold"


@pytest.mark.parametrize("goal", [None, np.ones(3), np.array([np.inf, 0.0])])
def test_a_motion_to_nowhere_is_refused_and_held(bench, goal):
    following(bench, wave(60))
    bench.say("motion", goal=goal)
    bench.run(20)
    assert "expected 2 values" in bench.said("refusals")[0].text
    assert bench.behaviour == "hold"


def test_a_motion_leaves_alone_what_its_goal_does_not_name(bench):
    bench.measured = np.array([0.3, -0.2])
    bench.say("motion", goal=np.array([np.nan, 0.1]))
    bench.run(60)
    assert bench.sent[:, 0] == pytest.approx(0.3)
    assert bench.sent[-1] == pytest.approx([0.3, 0.1], abs=1e-3)
    assert bench.said("motion_done")


def test_ticks_of_a_run_that_is_moved_by_hand_are_that_run_s(bench):
    bench.say("hold", run=4)
    bench.say("motion", goal=np.array([0.1, 0.0]), run=4, mode="manual")
    bench.run(40)
    records = bench.records()
    assert {record.run for record in records} == {4}
    assert {record.source for record in records} == {"motion", "hold"}


# --- what is said -------------------------------------------------------------------------------------------


def test_the_first_change_by_safety_is_told_and_then_their_sum_once_it_is_quiet(bench):
    rows = np.zeros((120, 2))
    rows[10:] = 0.45
    following(bench, rows)
    bench.run(70)
    said = [event for event in bench.said(quiet=()) if event.kind in ("limited", "limited_sum")]
    assert [event.kind for event in said] == ["limited", "limited_sum"]
    assert said[0].text.startswith("a limited from 0.4500 to 0.")
    assert "actions were limited, worst: a limited from 0.4500 to" in said[1].text
    assert said[0].step == 10
    changes = [abs(record.executed - record.smoothed).max() for record in bench.records()]
    limited = [step for step, change in enumerate(changes) if change > 1e-4]
    assert said[1].text.startswith(f"{len(limited)} actions")
    assert said[1].step == pytest.approx(limited[-1] + 30, abs=1)


def test_what_is_limited_again_and_again_is_told_once_a_second_at_most(bench):
    rows = np.zeros((300, 2))
    rows[::2] = 0.2
    following(bench, rows)
    bench.run(290)
    said = bench.said("limited")
    assert len(said) == 1


def test_a_new_order_closes_the_sum_of_what_was_limited(bench):
    rows = np.zeros((60, 2))
    rows[5:] = 0.45
    following(bench, rows)
    bench.run(7)
    bench.say("hold", run=1)
    bench.run()
    assert [event.kind for event in bench.said(quiet=())] == ["limited", "limited_sum"]


def test_status_says_whether_safety_changed_the_step_and_which_chunk_made_it(bench):
    rows = np.zeros((60, 2))
    rows[5:8] = 0.4
    following(bench, rows)
    assert (bench.status["limited"], bench.status["chunk"], bench.status["chunks"]) == (0, 1, 1)
    bench.run(5)
    assert bench.status["limited"] == 1
    bench.chunk(2, np.zeros((60, 2)))
    bench.run(2)
    assert bench.status["chunks"] == 2
    bench.say("hold", run=1)
    bench.run()
    assert (bench.status["limited"], bench.status["chunk"], bench.status["chunks"]) == (0, -1, 0)


def test_refusals_that_come_and_go_are_not_told_each_time(bench):
    rows = np.zeros((120, 2))
    rows[5::3] = np.nan
    following(bench, rows)
    bench.run(60)
    assert len(bench.said("refused")) == 1


def test_everything_is_said_with_its_step(bench):
    following(bench, wave(5))
    bench.run(10)
    assert [event.step for event in bench.said("starved")] == [5]


def test_a_full_ring_is_counted_and_never_waited_for(bench):
    bench.shared.rings["ticks"].push = lambda payload: not isinstance(decode(payload), ExecutedTick)
    following(bench)
    bench.run(3)
    assert bench.status["records_lost"] == 4
    assert len(bench.sink.sent) == 4
