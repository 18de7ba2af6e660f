import numpy as np
import pytest

from runtime.ipc.observation_reader import LatestObservation
from runtime.ipc.shared_state import EStop
from runtime.motion.timeline import DimensionKinds
from runtime.processes.control.actuator import RobotActuator, SimulatedActuator, TickSettings
from runtime.processes.control.behaviours import Target
from runtime.safety.filter import Limits, SafetySettings
from tests.runtime.tick_bench import NO, PERIOD, Bench

HELD = Target(np.zeros(2), "hold", None)


def settings(limits=None, **options):
    fields = {
        "period": PERIOD,
        "limits": limits or Bench().limits,
        "dims": DimensionKinds(),
        "safety": SafetySettings(),
        "heartbeat_timeout": lambda process: 1.0,
        "starvation": "slow",
        "starvation_hold": 1.0,
    }
    return TickSettings(**(fields | options))


def robot(bench, **options):
    return RobotActuator(bench.shared, bench.sink, settings(**options), bench.clock.now)


def seen(*joints, captured=100.0):
    qpos = np.array(joints, np.float32)
    return LatestObservation(1, qpos, qpos.astype(float), captured, (("cam", 99.9),), True)


@pytest.mark.parametrize(("answer", "patience"), [("slow", 1.0), ("hold", 0.0), ("stop", 0.0)])
def test_only_slow_has_patience_with_starvation(answer, patience):
    assert settings(starvation=answer).starvation_patience == patience


def test_elapsed_time_is_capped_and_the_first_tick_counts_as_one_period():
    simulated = SimulatedActuator(np.zeros(2), settings(), lambda: 0.0)
    assert simulated.elapsed(50.0) == PERIOD
    simulated.end_tick(50.0)
    assert simulated.elapsed(50.0 + PERIOD) == pytest.approx(PERIOD)
    assert simulated.elapsed(50.0 + 0.1 * PERIOD) == pytest.approx(0.5 * PERIOD)
    assert simulated.elapsed(60.0) == pytest.approx(1.5 * PERIOD)


def test_a_simulated_robot_is_where_it_was_told_to_be_and_its_joints_are_never_old():
    simulated = SimulatedActuator(np.array([0.1, 0.2]), settings(), lambda: 7.0)
    sent = simulated.send(3, 100.0, HELD, np.array([0.2, 0.2]))
    state = simulated.state(seen(9.0, 9.0, captured=1.0), 100.0, None)
    assert (sent.time, sent.executed.tolist()) == (7.0, [0.2, 0.2])
    assert state.measured.tolist() == state.previous.tolist() == [0.2, 0.2]
    assert state.joint_age == 0.0
    assert state.picture_ages == {"cam": pytest.approx(0.1)}


def test_a_robot_is_judged_by_its_measured_joints_and_their_age():
    state = robot(Bench()).state(seen(0.3, 0.4, captured=99.5), 100.0, None)
    assert state.measured == pytest.approx([0.3, 0.4])
    assert state.joint_age == pytest.approx(0.5)


def test_old_or_incomplete_joints_are_no_measurement():
    actuator = robot(Bench())
    assert actuator.measured(seen(0.3, 0.4), 100.1) == pytest.approx([0.3, 0.4])
    assert actuator.measured(seen(0.3, 0.4), 100.3) is None
    qpos = np.array([np.nan, 0.0], np.float32)
    assert actuator.measured(LatestObservation(1, qpos, qpos.astype(float), 100.0, (), False), 100.0) is None


def test_an_angle_that_wraps_is_counted_in_the_turn_of_the_last_command():
    """An e-stop that sent 3.0 after 9.4 would unwind the joint by a whole turn."""
    limits = Limits(("t", "b"), np.array([-np.inf, -2.0]), np.array([np.inf, 2.0]), np.full(2, 3.0), NO, NO)
    actuator = robot(Bench(), limits=limits, dims=DimensionKinds(wrapping=(0,)))
    actuator.engage(np.array([3.0, 0.1]))
    actuator.commanded = np.array([3.0 + 2 * np.pi, 0.1])
    measured = actuator.measured(seen(3.05, 0.1), 100.0)
    assert measured == pytest.approx([3.05 + 2 * np.pi, 0.1])


def test_a_brake_at_an_angle_without_limits_is_as_soft_as_configured():
    limits = Limits(("t", "b"), np.array([-np.inf, -2.0]), np.array([np.inf, 2.0]), np.full(2, 3.0), NO, NO)
    actuator = robot(Bench(), limits=limits, dims=DimensionKinds(wrapping=(0,)))
    actuator.engage(np.zeros(2))
    actuator.velocity = np.array([2.0, 0.0])
    assert actuator.braking_motion().duration == pytest.approx(2.0 / 20.0)


def test_a_binary_gripper_has_no_velocity_to_brake_from():
    limits = Limits(("a", "g"), np.zeros(2), np.ones(2), np.full(2, 3.0), ~NO, np.array([False, True]))
    actuator = SimulatedActuator(np.zeros(2), settings(limits=limits), lambda: 0.0)
    actuator.send(0, 100.0, HELD, np.array([0.01, 1.0]))
    assert actuator.velocity[0] > 0
    assert actuator.velocity[1] == 0


def test_the_e_stop_pressed_within_a_tick_repeats_the_last_command_to_the_robot():
    bench = Bench()
    actuator = robot(bench)
    actuator.engage(np.array([0.1, 0.1]))
    bench.shared.set_estop(EStop.LATCHED)
    sent = actuator.send(0, 100.0, Target(np.ones(2), "policy", "policy"), np.ones(2))
    assert sent.executed.tolist() == [0.1, 0.1]
    assert bench.sent.tolist() == pytest.approx([pytest.approx([0.1, 0.1])])


def test_a_stop_after_a_step_to_where_the_robot_is_begins_at_rest():
    """That is no speed to brake from, and the record says why the command is elsewhere."""
    actuator = robot(Bench())
    actuator.engage(np.zeros(2))
    actuator.rebase_command(np.array([0.3, -0.1]), "moved by hand")
    assert actuator.braking_motion().duration == 0.0
    sent = actuator.send(0, 100.0, HELD, np.array([0.3, -0.1]))
    assert sent.notes == ("moved by hand: a stepped 0.300 rad",)
    assert actuator.send(1, 100.0 + PERIOD, HELD, np.array([0.3, -0.1])).notes == ()


def test_a_step_ends_within_the_joint_limits_and_goes_no_farther_than_it_may():
    actuator = robot(Bench())
    actuator.engage(np.array([1.9, 0.0]))
    actuator.rebase_command(np.array([2.05, 1.0]), "e-stop", np.array([1.0, 0.2]))
    assert actuator.commanded.tolist() == pytest.approx([2.0, 0.2])


def test_what_no_limit_allows_does_not_leave_whoever_wants_it_sent():
    bench = Bench()
    actuator = robot(bench)
    actuator.engage(np.zeros(2))
    sent = actuator.send(0, 100.0, HELD, np.array([1.5, np.nan]))
    assert bench.sent[-1] == pytest.approx([60 * 1.05 * PERIOD**2, 0.0])
    assert sent.corrected == (
        "last check: a 1.5000 was to be sent, 0.0700 is; last check: b nan was to be sent, 0.0000 is"
    )


def test_what_moves_no_robot_and_what_is_only_reported_on_leaves_as_it_is():
    bench = Bench()
    for options in ({"moves_robot": False}, {"safety": SafetySettings(report_only=True)}):
        actuator = robot(bench, **options)
        actuator.engage(np.array([3.0, 0.0]))
        actuator.send(0, 100.0, HELD, np.array([-1.5, 5.0]))
        assert bench.sent[-1] == pytest.approx([-1.5, 5.0])
