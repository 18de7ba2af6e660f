import math

import numpy as np
import pytest

from runtime.ipc.messages import MergeResult, NodeRequest, Order, decode, encode
from runtime.ipc.shared_state import EStop
from tests.runtime.tick_bench import PERIOD, WITH_GRIPPER, Bench, following, wave


@pytest.fixture
def bench():
    return Bench()


def test_a_new_control_keeps_silent(bench):
    bench.run(5)
    assert bench.sink.sent == []
    assert bench.behaviour == "silent"


def test_nothing_is_sent_before_the_guard_has_read_its_latch():
    bench = Bench()
    bench.shared.set_estop(EStop.UNKNOWN)
    following(bench)
    bench.run(3)
    assert bench.sink.sent == []


def test_the_action_for_a_step_is_sent_at_that_step(bench):
    following(bench)
    bench.run(9)
    assert np.allclose(bench.sink.sent, wave(10), atol=1e-6)


def test_a_stop_decelerates_and_then_the_held_target_is_sent_on_every_tick(bench):
    following(bench, wave(60, speed=1.5))
    bench.run(9)
    bench.say("hold")
    bench.run(30)
    sent = np.array(bench.sink.sent)[:, 0]
    assert len(sent) == 40
    steps = np.diff(sent[9:])
    assert (np.diff(steps) <= 1e-6).all()  # slowing down only
    assert (steps >= -1e-7).all()  # never back
    assert (sent[-20:] == sent[-1]).all()


def test_a_motion_arrives_holds_and_says_so(bench):
    bench.say("motion", goal=np.array([0.5, -0.5]))
    bench.run(60)
    assert np.allclose(bench.sink.sent[-1], [0.5, -0.5], atol=1e-3)
    assert [e.kind for e in bench.said("motion_done")] == ["motion_done"]
    assert bench.behaviour == "hold"


def test_a_motion_is_interrupted_within_one_tick(bench):
    bench.say("motion", goal=np.array([1.5, 0.0]))
    bench.run(20)
    bench.say("hold")
    bench.run()
    assert bench.behaviour == "hold"


def test_the_e_stop_sends_the_measured_position_and_refuses_everything_else(bench):
    following(bench)
    bench.run(5)
    bench.shared.set_estop(EStop.LATCHED)
    bench.measured = bench.moved_by_hand = np.array([0.07, 0.03])
    bench.say("motion", goal=np.array([1.0, 1.0]))
    bench.run(6)
    assert np.allclose(bench.sink.sent[-1], [0.07, 0.03], atol=1e-4)
    assert bench.shared.control.read()["estop_obeyed"]
    assert bench.said("estopped")


def test_the_e_stop_repeats_the_last_position_where_the_measurement_is_old(bench):
    following(bench)
    bench.run(5)
    bench.feed = False
    bench.run(15)
    last = bench.sink.sent[-1]
    bench.shared.set_estop(EStop.LATCHED)
    bench.measured = np.array([1.0, 1.0])
    bench.run(1)
    assert (bench.sink.sent[-1] == last).all()


def test_an_arm_that_comes_back_elsewhere_under_e_stop_is_not_pulled_to_where_it_was(bench):
    """It was switched off and on again after the e-stop, as one does."""
    bench.say("motion", goal=np.zeros(2))
    bench.run(3)
    bench.shared.set_estop(EStop.LATCHED)
    bench.run(30)
    bench.feed = False
    bench.run(40)
    bench.feed, bench.measured = True, np.array([0.3, 0.0])
    bench.moved_by_hand = bench.measured
    bench.run(3)
    told = len(bench.sink.sent)
    assert bench.sent[told - 3 :] == pytest.approx(
        np.tile([0.0, 0.0], (3, 1)), abs=1e-6
    )  # until it is believed
    bench.run(5)
    way = np.array([0.1, 0.2, 0.3, 0.3, 0.3])  # no faster than it moves
    assert bench.sent[told:] == pytest.approx(np.outer(way, [1.0, 0.0]), abs=1e-6)
    bench.shared.set_estop(EStop.CLEAR)
    bench.run(5)
    assert bench.sent[-1] == pytest.approx([0.3, 0.0], abs=1e-6)


def push(bench, way):
    """A hand moves the arm by `way` [D] as fast as a joint moves."""
    here = bench.measured.copy()
    for part in np.linspace(0.0, 1.0, round(np.abs(way).max() / (3.0 * PERIOD)) + 1)[1:]:
        bench.measured = bench.moved_by_hand = here + part * way
        bench.run()


@pytest.mark.parametrize("mode", ["step", "preview", "continuous"])
@pytest.mark.parametrize("unseen", [False, True])
def test_an_arm_that_was_moved_while_a_run_waits_is_held_where_it_is(mode, unseen):
    bench = Bench({"kind": "sync"})
    bench.say("follow", run=1, mode=mode)
    bench.chunk(1, wave(10, 0.1), waited=True)
    bench.run(30)
    assert bench.status["waiting"]
    if unseen:
        bench.feed = False
        bench.run(40)
        bench.feed = True
    bench.said()
    if unseen:
        bench.measured = bench.moved_by_hand = bench.sent[-1] + 0.3
    else:
        push(bench, np.full(2, 0.65))
    bench.run(45)
    told = len(bench.sink.sent)
    bench.run(5)
    assert bench.behaviour == "hold"
    assert [event.kind for event in bench.said()] == ["moved_away"]
    assert bench.sent[told:] == pytest.approx(np.tile(bench.measured, (5, 1)), abs=1e-6)


def test_a_gripper_that_was_on_its_way_to_its_lock_does_not_go_on_after_an_e_stop():
    bench = Bench(limits=WITH_GRIPPER)
    bench.say("motion", goal=np.zeros(3))
    bench.run(3)
    bench.lock(float("nan"), float("nan"), 0.1)
    bench.run(2)
    bench.shared.set_estop(EStop.LATCHED)
    bench.run(10)
    stood = bench.sent[-1]
    assert 0.0 < stood[2] < 0.09
    bench.shared.set_estop(EStop.CLEAR)
    bench.run(30)
    assert bench.sent[-1] == pytest.approx(stood, abs=1e-6)
    assert np.isnan(bench.status["locked"]).all()


def test_releasing_the_e_stop_holds_and_does_not_go_on(bench):
    following(bench)
    bench.shared.set_estop(EStop.LATCHED)
    bench.run(2)
    bench.shared.set_estop(EStop.CLEAR)
    bench.run(10)
    assert bench.behaviour == "hold"
    assert (np.array(bench.sink.sent[-5:]) == bench.sink.sent[-1]).all()


def test_refused_actions_in_a_row_lead_to_holding_never_to_silence(bench):
    following(bench, np.vstack([wave(3), np.full((40, 2), 1.9)]))  # a jump that is refused
    bench.run(20)
    assert len(bench.sink.sent) == 21
    assert bench.behaviour == "hold"
    held = bench.said()
    assert [e.kind for e in held] == ["refused", "refusals"]
    assert "10 actions refused in a row" in held[1].text


def test_nan_from_the_policy_is_never_sent(bench):
    rows = wave(60)
    rows[5:] = np.nan
    following(bench, rows)
    bench.run(20)
    assert np.isfinite(bench.sink.sent).all()
    assert bench.behaviour == "hold"


def test_old_observations_lead_to_holding_with_the_reason(bench):
    following(bench, wave(90))
    bench.feed = False
    bench.run(40)
    assert bench.behaviour == "hold"
    assert "joint readings are" in bench.said("refusals")[0].text


def test_a_dead_main_makes_control_hold_and_keep_sending(bench):
    following(bench, wave(90))
    bench.alive = False
    bench.run(40)
    assert bench.behaviour == "hold"
    assert "coordinator" in bench.said("family")[0].text
    assert len(bench.sink.sent) == 41


def test_starvation_is_named_slows_down_and_recovers_by_itself(bench):
    following(bench, wave(5))
    bench.run(10)
    assert [e.kind for e in bench.said()] == ["starved"]
    assert bench.behaviour == "follow"
    here = bench.sink.sent[-1][0]
    bench.chunk(2, wave(30, start=here))
    bench.run(5)
    assert [e.kind for e in bench.said()] == ["recovered"]


def test_starvation_becomes_holding_after_its_time(bench):
    following(bench, wave(5))
    bench.run(45)
    assert bench.behaviour == "hold"
    assert "no usable chunk" in bench.said("starvation")[0].text


def test_waiting_is_no_starvation_for_sync_and_every_action_is_executed_in_order():
    bench = Bench({"kind": "sync"})
    bench.say("follow", run=1)
    bench.chunk(1, wave(5), waited=True)
    bench.run(51)
    assert bench.behaviour == "follow"
    assert bench.said() == []
    bench.chunk(2, wave(5, start=bench.sink.sent[-1][0]), step=6, waited=True)
    bench.run(10)
    executed = [r.executed[0] for r in bench.records() if r.source == "policy"]
    assert len(executed) == 10


def test_a_stall_of_half_a_second_is_skipped_not_caught_up(bench):
    following(bench, wave(120, speed=0.6))
    bench.run(10)
    bench.step += 15
    bench.clock.advance(0.5)
    bench.run(10)
    moves = np.abs(np.diff(np.array(bench.sink.sent)[:, 0]))
    assert len(bench.sink.sent) == 21
    assert moves.max() <= 3.0 * 1.5 * PERIOD + 1e-6  # velocity limit times the capped elapsed time
    assert bench.sink.sent[-1][0] == pytest.approx(wave(120, 0.6)[bench.step - 1, 0], abs=1e-5)


def test_chunks_of_a_run_that_is_over_are_ignored(bench):
    following(bench)
    bench.say("hold", run=0)
    bench.chunk(9, wave(30, start=1.0))
    bench.run(3)
    merged = [decode(m) for m in bench.shared.rings["control_events"].drain()]
    assert [m.dropped for m in merged if isinstance(m, MergeResult)] == [
        "",
        "control is not following that run any more",
    ]


def test_a_restarted_control_goes_on_holding_where_it_stood(bench):
    following(bench)
    bench.run(10)
    last = bench.sink.sent[-1]
    bench.tick = bench.new_tick()
    bench.run(3)
    assert bench.behaviour == "hold"
    assert np.allclose(bench.sink.sent[-1], last)


def test_a_brake_at_speed_stops_before_the_joint_limit(bench):
    bench = Bench(following_error=9.0, jump=9.0)
    following(bench, wave(90, speed=2.9))
    bench.run(16)
    bench.chunk(2, np.full((30, 2), 2.0))
    bench.run(3)
    bench.say("hold")
    bench.run(30)
    assert np.max(bench.sink.sent) <= 2.0 + 1e-6


def test_each_tick_is_written_down_with_its_source_and_its_makers(bench):
    following(bench)
    bench.run(2)
    bench.say("hold", run=1)
    bench.run(1)
    records = bench.records()
    assert [r.source for r in records] == ["policy", "policy", "policy", "hold"]
    assert records[1].chunk_ids == [1]
    assert records[3].run == 1
    assert records[3].smoothed is None
    assert (records[2].executed == bench.sink.sent[2]).all()


def test_an_e_stop_from_before_this_start_sends_nothing_until_the_robot_has_been_measured():
    bench = Bench(seen=False)
    bench.shared.set_estop(EStop.LATCHED)
    bench.feed = False
    bench.run(5)
    assert bench.sink.sent == []  # nobody knows where the robot is: zero would be a command to go there
    assert bench.shared.control.read()["estop_obeyed"]
    bench.measured, bench.feed = np.array([0.4, -0.3]), True
    bench.run(6)
    assert np.allclose(bench.sink.sent, [[0.4, -0.3]] * 3)  # and not before several samples agree
    bench.shared.set_estop(EStop.CLEAR)
    bench.run(3)
    assert np.allclose(bench.sink.sent[-1], [0.4, -0.3])


def test_releasing_an_e_stop_over_a_robot_that_was_never_measured_keeps_silent():
    bench = Bench(seen=False)
    bench.shared.set_estop(EStop.LATCHED)
    bench.feed = False
    bench.run(3)
    bench.shared.set_estop(EStop.CLEAR)
    bench.run(3)
    assert bench.behaviour == "silent"
    assert bench.sink.sent == []


@pytest.mark.parametrize("order", [{"kind": "follow", "run": 1}, {"kind": "motion", "goal": np.ones(2)}])
@pytest.mark.parametrize("qpos", [None, np.array([np.nan, 0.0], np.float32)])
def test_a_robot_that_is_not_measured_is_not_taken_over(order, qpos):
    bench = Bench(seen=False)
    bench.feed = False
    if qpos is not None:
        bench.observe(qpos=qpos)
    bench.say(**order)
    bench.run(3)
    assert bench.sink.sent == []
    assert bench.behaviour == "silent"
    assert "no fresh joints" in bench.said("unmeasured")[0].text


def test_a_policy_that_is_always_too_late_starves_and_is_held(bench):
    bench.say("follow", run=1)
    bench.run(10)
    for number in range(20):
        bench.chunk(number, wave(5), step=bench.step - 9)
        bench.run(5)
    events = bench.said()
    assert [e.kind for e in events] == ["starved", "starvation"]
    assert bench.behaviour == "hold"
    assert (np.array(bench.sink.sent) == 0.0).all()


def test_a_chunk_that_comes_too_late_does_not_end_a_starvation(bench):
    following(bench, wave(5))
    bench.run(10)
    bench.chunk(2, wave(5), step=bench.step - 9)
    bench.run(4)
    assert [e.kind for e in bench.said()] == ["starved"]


def test_the_record_of_a_tick_is_on_its_way_before_main_can_see_the_tick(bench):
    seen = []
    push = bench.shared.rings["ticks"].push
    bench.shared.rings["ticks"].push = lambda payload: (
        seen.append((type(decode(payload)).__name__, int(bench.shared.control.read()["step"])))
        or push(payload)
    )
    following(bench)
    bench.run()
    assert seen == [("ExecutedTick", 0), ("MergeResult", 0), ("ExecutedTick", 0)]


def test_an_e_stop_pressed_within_a_tick_repeats_the_last_command(bench):
    following(bench, wave(60, speed=1.5))
    bench.run(5)
    last = bench.sink.sent[-1]
    bench.before_send = lambda: bench.shared.set_estop(EStop.LATCHED)
    bench.run()
    assert np.allclose(bench.sink.sent[-1], last)
    assert bench.records()[-1].notes == ["e-stop pressed within the tick"]
    bench.run()
    assert bench.behaviour == "estop"


def test_a_motion_is_not_done_while_it_is_refused(bench):
    bench.say("motion", goal=np.array([0.8, 0.0]))
    bench.run(12)
    bench.feed = False
    bench.run(20)
    assert bench.said("motion_done") == []
    assert bench.behaviour == "hold"


def test_a_motion_that_was_refused_for_a_while_still_comes_to_its_end(bench):
    bench.say("motion", goal=np.array([0.8, 0.0]))
    bench.run(12)
    bench.feed = False
    bench.run(10)
    bench.feed = True
    bench.run(25)
    assert [e.kind for e in bench.said()] == ["refused", "motion_done"]
    assert np.allclose(bench.sink.sent[-1], [0.8, 0.0], atol=1e-3)


def test_a_stop_is_no_harder_than_the_brake_allows(bench):
    following(bench, wave(60, speed=1.5))
    bench.run(9)
    bench.say("hold")
    bench.run(10)
    steps = np.diff(np.array(bench.sink.sent)[:, 0])
    assert np.diff(steps).min() == pytest.approx(-20.0 * PERIOD**2, abs=1e-6)
    assert steps[9] == pytest.approx(1.5 * PERIOD - 0.5 * 20.0 * PERIOD**2, abs=1e-6)


def test_full_speed_is_gathered_within_the_acceleration_and_then_kept(bench):
    following(bench, wave(20, speed=2.9))
    bench.run(15)
    steps = np.diff(np.array(bench.sink.sent)[:, 0])
    assert steps[0] == pytest.approx(60.0 * PERIOD**2, abs=1e-6)
    assert steps.max() <= 3.0 * PERIOD + 1e-6
    assert bench.sink.sent[-1][0] == pytest.approx(wave(20, speed=2.9)[15, 0], abs=1e-6)  # caught up


# --- what a robot may do meanwhile -------------------------------------------------------------------------


def test_an_arm_that_was_moved_while_held_is_held_where_it_is_now(bench):
    following(bench)
    bench.say("hold", run=1)
    bench.run(10)
    held = bench.sent[-1]
    push(bench, np.array([0.65, 0.1]))
    assert bench.sent[-1] == pytest.approx(held)  # until several samples agree
    bench.run(60)
    assert np.allclose(bench.sink.sent[-1], [0.65, 0.1])
    notes = [note for record in bench.records() for note in record.notes]
    assert notes[0] == "held where the robot is: a stepped 0.030 rad"  # as fast as motions of ours
    assert "held where the robot is: a stepped 0.100 rad" in notes  # no faster than it moves
    assert len(bench.said("displaced")) == 1
    bench.moved_by_hand = None
    bench.say("motion", goal=np.zeros(2))
    bench.run(90)
    assert np.allclose(bench.sink.sent[-1], 0.0, atol=1e-3)  # and it is not stuck there


def test_a_robot_that_comes_back_elsewhere_after_it_was_not_seen_is_held_where_it_is(bench):
    following(bench, wave(60, speed=1.0))
    bench.run(20)
    bench.say("hold", run=1)
    bench.run(10)
    held = bench.sink.sent[-1].copy()
    bench.feed = False
    bench.run(30)
    bench.feed = True
    bench.measured = bench.moved_by_hand = (
        held.astype(float) - 0.3
    )  # less than the following error, as after a power cycle
    bench.run(8)
    assert np.allclose(bench.sink.sent[-1], held - 0.3, atol=1e-6)


def brought_back(bench, elsewhere, stretch):
    """The bench from the first sample on that comes 0.7 s after the last one."""
    here = bench.moved_by_hand = bench.sent[-1].copy()
    bench.feed = False
    bench.run(math.ceil(0.7 / (PERIOD * stretch)), stretch)
    bench.feed = True
    bench.measured = bench.moved_by_hand = here + elsewhere


@pytest.mark.parametrize("stretch", [1.0, 3.0])  # at 10 Hz a gap is fewer refusals than lead to holding
@pytest.mark.parametrize("kind", ["follow", "motion"])
def test_what_moved_a_robot_does_not_go_on_where_that_comes_back_elsewhere(kind, stretch):
    bench = Bench({"kind": "naive"}, limits=WITH_GRIPPER)
    if kind == "follow":
        following(bench, wave(300, 0.2, dim=3) * [1, -1, 0])
    else:
        bench.say("motion", goal=np.array([1.9, -1.9, 0.0]), speed=0.4)
    bench.run(8, stretch)
    brought_back(bench, np.array([-0.2, 0.2, 0.0]), stretch)
    bench.run(8, stretch)
    assert bench.behaviour == "hold"
    assert bench.said()[-1].kind in ("moved_away", "displaced")
    assert bench.sent[-1] == pytest.approx(bench.measured, abs=1e-6)


@pytest.mark.some(15)
@pytest.mark.parametrize("stretch", [1.0, 3.0])
@pytest.mark.parametrize("before", ["follow", "motion", "hold", "estop"])
@pytest.mark.parametrize("ordered", ["nothing", "follow", "motion", "lock", "hold", "estop", "clear"])
def test_until_joints_that_come_back_are_believed_what_was_commanded_last_is(before, ordered, stretch):
    bench = Bench({"kind": "naive"}, limits=WITH_GRIPPER)
    following(bench, wave(300, 0.2, dim=3) * [1, -1, 0])
    bench.run(8, stretch)
    if before == "motion":
        bench.say("motion", goal=np.array([1.9, -1.9, 0.1]), speed=0.4)
    elif before == "hold":
        bench.say("hold")
    elif before == "estop":
        bench.shared.set_estop(EStop.LATCHED)
    bench.run(8, stretch)
    brought_back(bench, np.array([-0.3, 0.3, 0.0]), stretch)
    held = bench.sent[-1]
    if ordered == "follow":
        bench.say("follow", run=2)
        bench.chunk(2, held + wave(60, 0.5, dim=3) * [1, 1, 0.01], run=2)
    elif ordered == "motion":
        bench.say("motion", goal=np.array([0.5, 0.5, 0.05]))
    elif ordered == "lock":
        bench.lock(np.nan, np.nan, 0.09)
    elif ordered == "hold":
        bench.say("hold")
    elif ordered != "nothing":
        bench.shared.set_estop(EStop.LATCHED if ordered == "estop" else EStop.CLEAR)
    bench.run(1, stretch)
    while not bench.status["believed"]:
        assert bench.sent[-1] == pytest.approx(held, abs=1e-9)
        bench.run(1, stretch)


def test_a_gripper_on_its_way_to_its_lock_stops_while_nobody_knows_where_the_robot_is():
    bench = Bench(limits=WITH_GRIPPER)
    bench.say("motion", goal=np.zeros(3))
    bench.run(5)
    bench.lock(np.nan, np.nan, 0.1)
    bench.run(1)
    bench.feed = False
    bench.run(20)
    stood = bench.sent[-1]
    assert 0.0 < stood[2] < 0.09
    assert (np.diff(bench.sent[:, 2]) >= -1e-9).all()
    bench.run(10)
    assert (bench.sent[-10:] == stood).all()
    bench.feed = True
    bench.run(30)
    assert bench.sent[-1, 2] == pytest.approx(0.1)


def test_an_arm_that_sags_a_little_is_held_at_its_target(bench):
    following(bench)
    bench.say("hold", run=1)
    bench.run(10)
    held = bench.sink.sent[-1].copy()
    bench.moved_by_hand = held.astype(float) - 0.05
    bench.run(60)
    assert (bench.sink.sent[-1] == held).all()


@pytest.mark.some(13)
@pytest.mark.parametrize("ticks", range(20))
def test_a_spike_that_a_joint_could_have_moved_does_not_move_an_arm_under_e_stop(bench, ticks):
    following(bench, wave(60, speed=0.0))
    bench.run(5)
    bench.shared.set_estop(EStop.LATCHED)
    bench.run(ticks)
    bench.measured = np.array([0.3, 0.0])
    bench.run(30)
    assert np.abs(bench.sent).max() <= 1e-6


@pytest.mark.parametrize("sags", [0.02, 0.05, 0.1])
def test_an_arm_that_reads_below_its_command_is_not_led_away_by_the_e_stop(bench, sags):
    bench.say("motion", goal=np.zeros(2))
    bench.run(10)
    bench.shared.set_estop(EStop.LATCHED)
    for _ in range(40):
        bench.moved_by_hand = bench.sent[-1] - sags
        bench.run()
    assert np.abs(bench.sent).max() <= sags + 0.05 + 1e-6


def test_a_robot_that_rests_outside_its_limits_is_taken_over_inside_them_and_the_record_says_so():
    bench = Bench()
    bench.measured = np.array([2.05, 0.0])
    bench.say("motion", goal=np.array([1.9, 0.0]))
    bench.run(2)
    notes = [note for record in bench.records() for note in record.notes]
    assert notes[0] == "taken over inside its limits: a stepped 0.050 rad"
    assert bench.sent.max() <= 2.0


def test_a_node_that_comes_back_at_0_and_is_pulled_at_first_is_left_alone(bench):
    bench.say("motion", goal=np.full(2, 0.6))
    bench.run(60)
    bench.feed = False
    bench.run(20)
    bench.feed = True
    for part in (0.0, 0.02, 0.06, 0.1, 0.14, 0.18):
        bench.measured = bench.moved_by_hand = np.full(2, part)
        bench.run()
    assert "read exactly 0 rad after 0.600" in bench.said("displaced")[0].text
    told = len(bench.sink.sent)
    bench.run(10)
    assert len(bench.sink.sent) == told
    assert bench.behaviour == "silent"


def test_an_arm_under_e_stop_does_not_sink_under_its_own_measurement(bench):
    following(bench)
    bench.run(5)
    bench.shared.set_estop(EStop.LATCHED)
    bench.run(1)
    for _ in range(90):  # a joint that always ends up a little below where it is told to be
        bench.moved_by_hand = bench.sink.sent[-1].astype(float) - 0.02
        bench.run(1)
    sunk = bench.sink.sent[5] - bench.sink.sent[-1]
    assert sunk.max() < 0.5


def test_a_gap_brakes_as_hard_as_a_stop_does(bench):
    fast = Bench(following_error=9.0, jump=9.0)
    following(fast, wave(12, speed=2.0))
    fast.run(25)
    sent = np.array(fast.sink.sent)[:, 0]
    way = sent[-1] - sent[11]
    assert way == pytest.approx(2.0**2 / (2 * 20.0), rel=0.05)  # v^2 / 2a, not twice that


def test_a_gap_near_a_joint_limit_ends_before_it(bench):
    fast = Bench(following_error=9.0, jump=9.0)
    following(fast, wave(20, speed=2.9, start=0.0))
    fast.run(40)
    assert np.max(fast.sink.sent) <= 2.0 + 1e-6


def test_a_motion_goes_on_where_it_was_after_a_stall_and_keeps_its_own_limits(bench):
    bench.say("motion", goal=np.array([1.5, 0.0]))
    bench.run(20)
    bench.step += 15
    bench.clock.advance(0.5)
    bench.run(120)
    sent = np.array(bench.sink.sent)[:, 0]
    speed = bench.safety.motion_velocity_scale * 3.0 * 1.06
    assert np.diff(sent).max() <= speed * 1.5 * PERIOD
    assert sent[-1] == pytest.approx(1.5, abs=1e-3)


def test_a_motion_that_was_refused_for_a_while_starts_anew_from_where_it_stands(bench):
    bench.say("motion", goal=np.array([1.5, 0.0]))
    bench.run(20)
    bench.feed = False
    bench.run(13)  # some ticks within the joints' age, then refusals, fewer than lead to holding
    bench.feed = True
    bench.run(150)
    sent = np.array(bench.sink.sent)[:, 0]
    speeds = np.diff(sent) / PERIOD
    assert speeds.max() <= 0.9 * 1.06
    assert np.abs(np.diff(speeds)).max() <= 20.0 * PERIOD * 1.06  # the stop's deceleration, never a jerk
    assert sent[-1] == pytest.approx(1.5, abs=1e-3)


def test_a_motion_ordered_in_full_motion_stops_first(bench):
    fast = Bench(following_error=9.0, jump=9.0)
    following(fast, wave(60, speed=1.5))
    fast.run(20)
    fast.say("motion", goal=np.zeros(2))
    fast.run(120)
    speeds = np.diff(np.array(fast.sink.sent)[:, 0]) / PERIOD
    assert np.abs(np.diff(speeds)[20:]).max() <= 20.0 * PERIOD * 1.06
    assert fast.sink.sent[-1] == pytest.approx(np.zeros(2), abs=1e-3)


def test_a_run_that_begins_elsewhere_is_blended_from_the_held_target(bench):
    bench.say("follow", run=1)
    bench.chunk(1, wave(60, speed=0.1, start=0.4))
    bench.run(30)
    sent = np.array(bench.sink.sent)[:, 0]
    assert np.diff(sent).max() < 0.08
    assert sent[0] == pytest.approx(0.0, abs=1e-6)
    assert sent[-1] == pytest.approx(wave(60, 0.1, 0.4)[29, 0], abs=1e-5)


def test_every_second_action_refused_is_as_bad_as_all_of_them(bench):
    rows = wave(120)
    rows[6::2] = np.nan
    following(bench, rows)
    bench.run(40)
    assert bench.behaviour == "hold"
    assert "of the last" in bench.said("refusals")[0].text


def test_a_motion_refused_again_after_it_stopped_never_jumps_back(bench):
    """The stop of the first refusal is over once something else was sent: it must not go on from there."""
    bench.say("motion", goal=np.array([1.5, 0.0]))
    bench.run(20)
    fresh = bench.feed
    for _ in range(4):  # the joints are old for a few ticks, seen again for one, and old again
        bench.feed = False
        bench.run(9)
        bench.feed = fresh
        bench.run(1)
    sent = np.array(bench.sink.sent)[:, 0]
    assert np.diff(sent).min() >= -1e-6


def ask_node(bench, word="scene_reset", **data):
    bench.shared.rings["orders"].push(encode(NodeRequest(word, data)))


def test_a_word_for_the_node_goes_to_the_sink_and_moves_nothing(bench):
    ask_node(bench, id="r", seed=3)
    bench.run()
    assert bench.sink.told == [("scene_reset", {"id": "r", "seed": 3})]
    assert bench.sink.sent == []
    assert bench.behaviour == "silent"


def test_a_sink_that_takes_no_words_is_an_event_and_not_the_end_of_control(bench):
    bench.sink.takes_words = False
    ask_node(bench)
    bench.run(2)
    said = bench.said("word_refused")
    assert [event.text for event in said] == [
        "this transport takes no control words; 'scene_reset' was to be sent"
    ]


@pytest.mark.parametrize("state", [EStop.LATCHED, EStop.UNKNOWN])
def test_no_word_reaches_the_node_while_the_e_stop_is_not_clear(bench, state):
    bench.shared.set_estop(state)
    ask_node(bench)
    bench.run()
    assert bench.sink.told == []
    assert "scene_reset is not passed on to the node while the e-stop" in bench.said("word_refused")[0].text


def smoothed(bench):
    return bench.shared.control.read()["smoothed"].tolist()


def test_the_status_says_what_was_wanted_before_safety_and_nan_where_nothing_was(bench):
    bench.say("hold")
    bench.run()
    assert np.isnan(smoothed(bench)).all()
    bench.say("follow", run=1)
    bench.run()
    bench.chunk(1, np.full((3, 2), 0.4))  # farther than one tick may go
    bench.run()
    assert smoothed(bench) == pytest.approx([0.4, 0.4], abs=0.4)
    assert smoothed(bench) == bench.records()[-1].smoothed.tolist()
    bench.run(2)
    wanted, sent = smoothed(bench), bench.sink.sent[-1].tolist()
    assert wanted == pytest.approx([0.4, 0.4])
    assert sent[0] < 0.39
    bench.say("hold")
    bench.run()
    assert np.isnan(smoothed(bench)).all()


@pytest.mark.parametrize("payload", [b"", b"\xc1", encode(Order(1, "hold"))[:-3]])
def test_a_message_that_is_none_is_said_and_control_goes_on(bench, payload):
    following(bench)
    bench.shared.rings["orders"].push(payload)
    bench.say("hold", run=1)
    bench.run(3)
    assert len(bench.said("unreadable")) == 1
    assert bench.behaviour == "hold"
    assert len(bench.sink.sent) == 4


def test_a_joint_whose_stamps_stood_still_is_met_where_it_is_read_then(bench):
    """Messages of the other joint go on meanwhile."""
    following(bench, wave(60, 0.0))
    bench.say("hold", run=1)
    bench.run(60)
    stamp, bench.feed = bench.clock.now(), False
    for tick in range(90):
        read = np.array([0.001 * (tick % 2), 0.0], np.float32)
        bench.observe(qpos=read, captured={"joints": stamp, "cam": bench.clock.now()})
        bench.run()
    bench.feed, bench.moved_by_hand = True, np.array([0.001, -0.4])
    bench.measured = bench.moved_by_hand
    bench.run(30)
    assert bench.sent[-1] == pytest.approx([0.001, -0.4], abs=0.01)
