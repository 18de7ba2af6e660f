"""An arm that stands below its command, as gravity and a payload make it: nothing that stops it may make it sink."""

import numpy as np
import pytest

from tests.runtime.compliant import Compliant, standing
from tests.runtime.tick_bench import PERIOD, following, wave

ERRORS = [0.01, 0.03, -0.05, 0.098]


@pytest.mark.some(4)
@pytest.mark.parametrize("noise", [0.0, 0.001])
@pytest.mark.parametrize("error", ERRORS)
def test_an_e_stop_leaves_an_arm_that_stands_where_it_stands(error, noise):
    bench = standing(error, noise=noise)
    stood = bench.sent[-1]
    for _ in range(6):
        bench.stop().seconds(1.5)
        bench.release().seconds(0.4)
    assert bench.sent[-1] == pytest.approx(stood, abs=1e-9)


@pytest.mark.parametrize("error", ERRORS)
def test_a_control_that_is_restarted_under_the_e_stop_goes_on_with_the_command_of_the_one_before(error):
    bench = standing(error).stop().seconds(1.0)
    for _ in range(5):
        bench.tick = bench.new_tick()
        bench.seconds(1.0)
    assert bench.sent[-1] == pytest.approx(np.zeros(2), abs=1e-9)


def test_a_restarted_control_takes_the_reading_where_that_is_farther_from_the_command():
    bench = standing(0.0).stop().seconds(1.0)
    bench.tick = bench.new_tick()
    bench.true = bench.true + np.array([0.0, 0.2])
    bench.error = np.array([0.0, -0.2])  # it lies on something now
    bench.seconds(2.0)
    assert bench.sent[-1, 0] == pytest.approx(0.0, abs=1e-6)
    assert bench.sent[-1, 1] > 0.15


@pytest.mark.some(2)
@pytest.mark.parametrize("error", ERRORS)
def test_a_stop_in_motion_ends_as_it_would_without_a_load(error):
    """Of which the command is the reading and the error that the joint had when it last stood, not its lag."""
    ends = []
    for load in (0.0, error):
        bench = standing(load)
        following(bench, wave(90, 1.0))
        bench.seconds(1.0)
        bench.stop().seconds(2.0)
        ends.append(bench.sent[-60:])
        for _ in range(5):  # which stands now
            bench.release().seconds(0.5)
            bench.stop().seconds(1.5)
        assert bench.sent[-1] == pytest.approx(ends[-1][-1], abs=1e-9)
    assert ends[1] == pytest.approx(ends[0], abs=2e-3)


@pytest.mark.parametrize("speed", [0.02, 0.6])
@pytest.mark.parametrize("presses", [0.3, 3.0])
def test_an_arm_that_presses_on_something_is_let_go_to_where_it_reads(speed, presses):
    bench = standing(0.02)
    bench.wall = bench.true + 0.03
    bench.say("follow", run=1)
    way = 0.1
    for first in range(0, round(way / speed / PERIOD), 15):
        bench.chunk(first + 1, wave(60, speed, speed * PERIOD * first).clip(max=way))
        bench.run(15)
    bench.say("hold", run=1)
    bench.seconds(presses)
    pressed = bench.sent[-1] - bench.true
    bench.stop().seconds(1.0)
    assert pressed.min() > 0.05
    assert bench.sent[-1] - bench.true == pytest.approx(np.full(2, 0.02), abs=3e-3)


@pytest.mark.some(4)
@pytest.mark.parametrize("error", ERRORS)
@pytest.mark.parametrize("stopped", [True, False])
def test_joints_that_are_missing_for_half_a_second_move_nothing(error, stopped):
    bench = standing(error)
    if stopped:
        bench.stop().seconds(1.0)
    for missing in (0.6, 2.0):
        bench.feed = False
        bench.seconds(missing)
        bench.feed = True
        bench.seconds(1.0)
    assert bench.sent[-1] == pytest.approx(np.zeros(2), abs=1e-9)


@pytest.mark.parametrize("error", ERRORS)
def test_an_arm_that_is_first_seen_under_the_e_stop_is_let_down_by_its_error_once(error):
    bench = Compliant(error, seen=False)
    bench.stop().seconds(2.0)
    assert len(bench.sent)
    assert np.abs(np.array(bench.course)).max() <= abs(error) + 1e-3


@pytest.mark.parametrize("error", ERRORS)
def test_a_take_over_lets_an_arm_down_by_its_error_once(error):
    bench = Compliant(error)
    bench.say("motion", goal=np.full(2, 0.01))
    bench.seconds(2.0)
    assert np.abs(np.array(bench.course)).max() <= abs(error) + 0.011


@pytest.mark.parametrize("error", ERRORS)
def test_hold_home_release_and_the_first_chunk_begin_at_the_command(error):
    bench = standing(error)
    bench.say("hold", run=1)
    bench.seconds(0.5)
    bench.stop().seconds(0.5)
    bench.release().seconds(0.5)
    bench.say("motion", goal=np.zeros(2))
    bench.seconds(0.5)
    following(bench, wave(60, 0.0))
    bench.seconds(1.0)
    assert bench.sent[-1] == pytest.approx(np.zeros(2), abs=1e-9)
    told = bench.sent[-90:]
    assert np.abs(told).max() <= 1e-9


@pytest.mark.parametrize("error", [0.03, 0.09])
def test_an_e_stop_just_after_a_take_over_leaves_the_command_where_it_is(error):
    bench = Compliant(error)
    bench.say("motion", goal=np.zeros(2))
    bench.seconds(0.1)
    at = bench.sent[-1].copy()
    bench.stop().seconds(2.0)
    assert bench.sent[-1] == pytest.approx(at, abs=0.011)


@pytest.mark.parametrize("error", [0.05, 0.09])
def test_a_joint_that_hangs_by_its_error_stays_while_another_one_is_led(error):
    """A hand moves the first joint, the second is not touched."""
    bench = standing(error).stop().seconds(1.5)
    before = bench.sent[-1].copy()
    for _ in range(2):
        bench.error = np.array([bench.error[0] + 0.8, error])
        bench.seconds(6.0)
    assert abs(bench.sent[-1][0] - before[0]) > 0.1
    assert bench.sent[-1][1] == pytest.approx(before[1], abs=1e-6)


@pytest.mark.parametrize("sags", [0.15, 0.3, 0.45])
def test_an_arm_that_sags_under_the_e_stop_stays_there_when_its_drive_is_switched_on_again(sags):
    bench = standing(0.03).stop().seconds(1.0)
    bench.limp = bench.true - sags
    bench.seconds(4.0)
    bench.limp = None
    bench.course.clear()
    bench.seconds(3.0)
    assert np.abs(np.array(bench.course) - bench.course[0]).max() <= bench.safety.steady_error
    assert not bench.said("implausible")
