import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.safety.limiter import CommandLimiter
from runtime.safety.limits import Limits
from runtime.safety.settings import SafetySettings
from tests.runtime.tick_bench import PERIOD

# A joint, a gripper that closes on the way, one that switches, a speed of a base.
LIMITS = Limits(
    ("joint", "gripper", "switch", "base"),
    np.array([-2.0, 0.0, 0.0, -0.5]),
    np.array([2.0, 0.1, 100.0, 0.5]),
    np.array([3.0, 1.0, 1.0, 1.0]),
    np.array([False, True, True, False]),
    np.array([False, False, True, False]),
    (3,),
)
limiter = CommandLimiter(LIMITS, SafetySettings())
places = st.tuples(st.floats(-2, 2), st.floats(0, 0.1), st.sampled_from([0.0, 100.0]), st.floats(-0.5, 0.5))
speeds = st.tuples(st.floats(-3, 3), st.floats(-1, 1), st.just(0.0), st.floats(-1, 1))
anything = st.tuples(*[st.floats(allow_nan=True, allow_infinity=True)] * 4)
lengths = st.floats(0.5 * PERIOD, 1.5 * PERIOD)


@given(anything, places, speeds, lengths, st.booleans())
def test_whatever_is_wanted_what_leaves_is_finite_within_limits_and_can_be_followed(
    wanted, previous, velocity, elapsed, stop
):
    previous, velocity = np.array(previous), np.array(velocity)
    sent = limiter(np.array(wanted), previous, velocity, elapsed, stop).action
    assert np.isfinite(sent).all()
    assert (LIMITS.excess(sent) <= 1e-6 * LIMITS.radian_scale).all()
    moved = (sent - previous) / elapsed
    follows = np.array([True, True, False, not stop])
    assert (np.abs(moved) <= LIMITS.velocity * 1.05 + 1e-4 * LIMITS.radian_scale)[follows].all()
    rate = 60.0 * LIMITS.radian_scale * 1.05
    least = np.minimum(velocity, 0.0) if stop else velocity
    most = np.maximum(velocity, 0.0) if stop else velocity
    within = (moved >= least - rate * elapsed - 1e-4 * LIMITS.radian_scale) & (
        moved <= most + rate * elapsed + 1e-4 * LIMITS.radian_scale
    )
    # Where a joint cannot stop before its limit any more, the limit comes first.
    at_limit = (sent <= LIMITS.lower + 1e-9) | (sent >= LIMITS.upper - 1e-9)
    too_fast = np.abs(velocity) > LIMITS.velocity * 1.05
    assert (within | at_limit | too_fast)[follows].all()


@given(places, lengths)
def test_what_may_be_sent_is_not_touched(previous, elapsed):
    previous = np.array(previous)
    action = np.clip(previous + 0.5 * LIMITS.radian_scale * elapsed**2, LIMITS.lower, LIMITS.upper)
    limited = limiter(action, previous, np.zeros(4), elapsed, False)
    assert limited.action is action
    assert limited.notes == ()


def test_a_gripper_that_switches_does_so_in_one_tick_and_only_between_its_ends():
    previous = np.zeros(4)
    action = np.array([0.0, 0.0, 100.0, 0.0])
    assert limiter(action, previous, np.zeros(4), PERIOD, False).action is action
    far = np.array([0.0, 0.0, 130.0, 0.0])
    limited = limiter(far, previous, np.zeros(4), PERIOD, False)
    assert limited.action[2] == 100.0
    assert limited.notes == ("last check: switch 130.0000 was to be sent, 100.0000 is",)


def test_a_stop_takes_any_velocity_away_at_once_and_a_base_stands():
    moving = np.array([2.9, 0.5, 0.0, 0.0])
    previous = np.array([0.5, 0.05, 0.0, 0.5])
    held = np.array([0.5, 0.05, 0.0, 0.0])
    assert limiter(held, previous, moving, PERIOD, True).action is held
    assert limiter(held, previous, moving, PERIOD, False).action[0] == pytest.approx(
        0.5 + (2.9 - 63.0 * PERIOD) * PERIOD
    )


def test_a_joint_outside_its_limits_may_stay_there_and_come_back_but_go_no_farther():
    outside = np.array([2.5, 0.0, 0.0, 0.0])
    for wanted, sent in ((2.6, 2.5), (2.5, 2.5), (2.46, 2.46)):
        action = np.array([wanted, 0.0, 0.0, 0.0])
        assert limiter(action, outside, np.zeros(4), PERIOD, False).action[0] == pytest.approx(sent)
