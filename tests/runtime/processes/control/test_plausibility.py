"""Of a joint at 0.8 rad that moves at most 3 rad/s, and two more; samples come at 30 Hz."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.ipc.observation_reader import LatestObservation
from runtime.motion.timeline import DimensionKinds
from runtime.processes.control.plausibility import JointPlausibility, TrustingPlausibility
from runtime.safety.limits import Limits
from tests.runtime.tick_bench import PERIOD

LIMITS = Limits(
    ("hip", "knee", "gripper"),
    np.array([-2.0, -2.0, 0.0]),
    np.array([2.0, 2.0, 0.1]),
    np.array([3.0, 3.0, 1.0]),
    np.array([False, False, True]),
    np.zeros(3, bool),
)
STANDS = np.array([0.8, -0.4, 0.05])
NAN = float("nan")


class Watcher:
    def __init__(self, limits=LIMITS, dims=None):
        self.judge = JointPlausibility(limits, dims or DimensionKinds())
        self.now, self.sequence, self.captured = 100.0, 0, 0.0

    def see(self, joints, commanded=None, stamp=True):
        """The doubt about one more sample."""
        self.now += PERIOD
        self.sequence += 1
        self.captured = self.now - 0.01 if stamp else self.captured
        joints = np.array(joints, float)
        seen = LatestObservation(
            self.sequence,
            joints.astype(np.float32),
            joints,
            self.captured,
            (),
            bool(np.isfinite(joints).all()),
        )
        return self.judge.judge(
            seen, self.now, None if commanded is None else np.array(commanded, float)
        ).implausible_reason

    def stand(self, ticks=5, joints=STANDS):
        return [self.see(joints) for _ in range(ticks)]

    def miss(self, ticks):
        seen = LatestObservation(self.sequence, STANDS.astype(np.float32), STANDS, self.captured, (), True)
        for _ in range(ticks):
            self.now += PERIOD
            self.judge.judge(seen, self.now, None)


@pytest.fixture
def watcher():
    return Watcher()


def stood(joints=STANDS):
    watcher = Watcher()
    watcher.stand(joints=joints)
    return watcher


def test_the_first_samples_are_believed_once_they_agree_for_a_while(watcher):
    doubts = watcher.stand(6)
    assert doubts[:3] == ["joint positions have been received for less than 0.1 s"] * 3
    assert doubts[3:] == ["", "", ""]


def test_a_first_sample_that_is_wrong_is_not_believed(watcher):
    watcher.see([0.0, 0.0, 0.0])
    assert all(watcher.stand(3))
    assert watcher.stand(3) == ["", "", ""]
    assert not watcher.judge.is_displaced(STANDS, 0.01)


def test_an_isolated_spike_is_named_and_over_with_the_next_sample():
    watcher = stood()
    assert watcher.see([0.8, 0.4, 0.05]) == (
        "knee reads 0.400 rad, -0.400 just before: faster than it moves (3.00 rad/s)"
    )
    assert watcher.see(STANDS) == ""


def test_a_reading_beyond_the_limits_is_never_believed():
    watcher = stood()
    for _ in range(60):
        assert watcher.see([5.0, -0.4, 0.05]) == "hip reads 5.000 rad, beyond its limits -2.000..2.000"
    assert watcher.see(STANDS) == ""


def test_an_arm_may_rest_a_little_beyond_its_limits(watcher):
    assert watcher.stand(6, [2.05, -0.4, 0.05])[-1] == ""


def test_zeros_of_a_dead_encoder_are_never_believed_however_long_they_last():
    watcher = stood()
    for _ in range(300):
        assert watcher.see([0.0, -0.4, 0.05]) == "hip read exactly 0 rad after 0.800: is an encoder dead?"
    assert watcher.judge.is_displaced(STANDS, 0.1) is False
    assert watcher.see(STANDS) == ""


def test_a_fast_joint_may_pass_exactly_0_on_its_way():
    watcher = stood([0.7, -0.4, 0.05])
    assert {watcher.see([hip, -0.4, 0.05]) for hip in (0.6, 0.48, 0.34, 0.17, 0.0, -0.15, -0.3)} == {""}


def test_a_joint_that_stands_at_exactly_0_is_believed_there_after_a_spike():
    watcher = stood(np.zeros(3))
    assert watcher.see([0.25, 0.0, 0.0]) == ""  # as far as it could have moved
    assert set(watcher.stand(5, np.zeros(3))) == {""}


@pytest.mark.parametrize("step", [0.03, 0.0, -0.01, -0.1])
def test_a_joint_that_dies_is_noticed_also_while_it_moves(step):
    watcher = stood([0.3 - step, -0.4, 0.05])
    watcher.see([0.3, -0.4, 0.05])
    assert watcher.see([0.0, -0.4, 0.05]).endswith("is an encoder dead?")


def test_swapped_joints_are_never_believed_however_long_they_last():
    watcher = stood()
    for _ in range(300):
        assert watcher.see([-0.4, 0.8, 0.05]) == "hip and knee read each other's values: are they swapped?"
    assert watcher.see(STANDS) == ""


def test_joints_that_are_swapped_within_what_they_can_move_are_noticed():
    watcher = stood([0.1, -0.1, 0.05])
    doubts = [watcher.see([-0.1, 0.1, 0.05]) for _ in range(30)]
    assert set(doubts) == {"hip and knee read each other's values: are they swapped?"}
    assert watcher.see([0.1, -0.1, 0.05]) == ""


def test_of_three_that_are_swapped_one_may_have_read_nearly_the_same():
    three = Limits(
        ("a", "b", "c"), np.full(3, -2.0), np.full(3, 2.0), np.full(3, 5.0), np.zeros(3, bool), LIMITS.binary
    )
    watcher = Watcher(three)
    watcher.stand(5, [1.406, 1.366, 0.855])
    doubts = [watcher.see([0.855, 1.406, 1.366]) for _ in range(30)]
    assert set(doubts) == {"a and b and c read each other's values: are they swapped?"}


@pytest.mark.parametrize("rate", [10, 30, 100])
@pytest.mark.parametrize("shift", np.linspace(0.0, 0.3, 16).tolist())
def test_joints_that_pass_each_other_at_full_speed_are_not_swapped(rate, shift):
    watcher, period = stood([-1.5, 1.5, 0.05]), 1 / rate
    for time in np.arange(0.0, 1.1, period):
        way = min(15.0 * time**2, 3.0 * time - 0.15)  # 30 rad/s2 up to 3 rad/s
        watcher.now += period - PERIOD
        assert watcher.see([-1.5 + way, 1.5 - shift - way, 0.05]) == ""


def test_samples_from_before_a_contradiction_do_not_count_for_how_long_others_agree():
    watcher = stood()
    watcher.stand(10, [-0.4, 0.8, 0.05])  # swapped
    assert watcher.stand(2, [0.6, -0.4, 0.05]) == ["", ""]
    assert not watcher.judge.is_settled
    watcher.stand(2, [0.6, -0.4, 0.05])
    assert watcher.judge.is_settled


def test_swapped_joints_are_noticed_beside_one_that_begins_another_turn():
    endless = Limits(
        ("hip", "knee", "wheel"),
        np.array([-2.0, -2.0, -np.inf]),
        np.array([2.0, 2.0, np.inf]),
        LIMITS.velocity,
        np.zeros(3, bool),
        LIMITS.binary,
    )
    watcher = Watcher(endless, DimensionKinds((), (2,)))
    watcher.stand(5, [0.8, -0.4, 3.141])
    doubts = [watcher.see([-0.4, 0.8, -3.141]) for _ in range(30)]
    assert set(doubts) == {"hip and knee read each other's values: are they swapped?"}


def test_an_arm_that_is_elsewhere_is_believed_once_several_samples_agree():
    watcher = stood()
    elsewhere = np.array([-0.5, 0.3, 0.05])
    doubts = watcher.stand(5, elsewhere)
    assert all(doubt.startswith("hip reads -0.500 rad") for doubt in doubts[:3])
    assert doubts[3:] == ["", ""]
    assert watcher.judge.is_displaced(STANDS, 0.5)


def test_an_encoder_that_was_noisy_and_is_stuck_elsewhere_is_never_believed():
    watcher = Watcher()
    for tick in range(10):
        watcher.see(STANDS + 1e-5 * (tick % 3))
    doubts = [watcher.see([-0.7, -0.4 + 1e-5 * (tick % 3), 0.05]) for tick in range(100)]
    assert doubts[0].startswith("hip reads -0.700 rad, 0.800 just before")
    assert set(doubts[3:]) == {"hip jumped to -0.700 rad and reads exactly that: is it stuck?"}
    assert watcher.see(STANDS) == ""


def test_an_encoder_is_known_to_be_noisy_by_samples_that_are_not_believed_too():
    watcher = stood()
    for tick in range(10):
        watcher.see(np.array([-0.4, 0.8, 0.05]) + 1e-5 * (tick % 3))  # swapped
    doubts = [watcher.see([-1.5, 0.8 + 1e-5 * (tick % 3), 0.05]) for tick in range(30)]
    assert set(doubts[3:]) == {"hip jumped to -1.500 rad and reads exactly that: is it stuck?"}


@pytest.mark.parametrize(("others", "stuck"), [(1e-5, True), (0.0, False)])
def test_a_joint_that_moved_and_is_still_where_it_jumped_to_is_stuck_unless_all_have_come_to_rest(
    others, stuck
):
    watcher = Watcher()
    for tick in range(12):
        watcher.see([0.8 - 0.01 * tick, -0.4, 0.05])
    doubts = [watcher.see([-0.7, -0.4 + others * (tick % 3), 0.05]) for tick in range(100)]
    assert doubts[0].startswith("hip reads -0.700 rad, 0.690 just before")
    assert set(doubts[3:]) == (
        {"hip jumped to -0.700 rad and reads exactly that: is it stuck?"} if stuck else {""}
    )


def test_an_encoder_that_was_noisy_leaps_as_far_as_the_joint_can_and_is_stuck_there_is_not_believed():
    watcher = Watcher()
    for tick in range(10):
        watcher.see(STANDS + 1e-5 * (tick % 3))
    doubts = []
    for tick in range(100):
        doubts.append(watcher.see([0.6, -0.4 + 1e-5 * (tick % 3), 0.05]))
        assert not watcher.judge.is_displaced(STANDS, 0.1)
    assert doubts[:2] == ["", ""]
    assert set(doubts[2:]) == {"hip jumped to 0.600 rad and reads exactly that: is it stuck?"}
    assert watcher.see(STANDS) == ""


def test_two_that_leap_and_are_stuck_there_are_not_believed_either():
    watcher = Watcher()
    for tick in range(10):
        watcher.see(STANDS + 1e-5 * (tick % 3))
    doubts = watcher.stand(30, [0.6, -0.2, 0.05])
    assert set(doubts[2:]) == {"hip jumped to 0.600 rad and reads exactly that: is it stuck?"}


def test_a_noisy_joint_that_is_fast_and_comes_to_rest_is_believed():
    watcher = Watcher()
    way = 0.8 - 0.2 * np.arange(5)
    for hip in (0.8, 0.80001, 0.8, 0.80001, 0.8, *way, 0.00001, 0.0, 0.00001):
        assert watcher.see([hip, -0.4, 0.05]) == "" or hip > 0.7
    assert watcher.judge.is_settled


@pytest.mark.some(4)
@pytest.mark.parametrize("seed", range(5))
def test_noise_of_a_broken_encoder_never_agrees_with_itself_for_long_enough(seed):
    watcher = stood()
    noise = np.random.default_rng(seed)
    for _ in range(3000):
        watcher.see([noise.uniform(-2, 2), -0.4, 0.05])
        assert not watcher.judge.is_displaced(STANDS, 0.5)


def test_what_contradicted_itself_again_and_again_has_to_agree_for_longer():
    watcher = stood()
    for value in (-1.9, 1.9, -1.0, 1.9):
        watcher.see([value, -0.4, 0.05])
    elsewhere = np.array([-1.5, -0.4, 0.05])
    doubts = watcher.stand(60, elsewhere)
    assert 10 < sum(map(bool, doubts)) < 60  # 0.1 s becomes 0.2, 0.4, 0.8, 1.6
    watcher.stand(120, elsewhere)
    assert sum(map(bool, watcher.stand(6, STANDS))) == 3


def test_what_contradicted_itself_is_believed_again_at_any_rate():
    watcher = stood()
    for _ in range(8):
        watcher.see([-0.5, 0.3, 0.05])
        watcher.see(STANDS)
    for _ in range(1500):
        watcher.now += 0.001 - PERIOD  # 1 kHz
        assert watcher.see(STANDS) == ""
    assert watcher.judge.is_settled


def test_an_arm_that_is_moved_as_fast_as_it_can_is_believed_all_the_way():
    watcher = Watcher()
    watcher.stand(5, [-1.5, 0.0, 0.05])
    way = np.arange(-1.5, 1.5, 3.0 * PERIOD)
    assert [watcher.see([hip, 0.0, 0.05]) for hip in way] == [""] * len(way)


@given(
    st.lists(st.floats(-1, 1), min_size=5, max_size=60),
    st.lists(st.floats(0.004, 0.09), min_size=5, max_size=60),
)
def test_no_motion_within_the_velocity_is_ever_doubted_whatever_the_stamps(speeds, gaps):
    """Parts of the velocity, and how long until the next sample, which control sees at its ticks."""
    watcher = stood()
    hip, captured = 0.8, watcher.captured
    for speed, gap in zip(speeds, gaps, strict=False):
        hip = float(np.clip(hip + 3.0 * speed * gap, -2.0, 2.0))
        captured += gap
        watcher.now = max(watcher.now + 1e-3, captured)
        joints = np.array([hip, -0.4, 0.05])
        seen = LatestObservation(1, joints.astype(np.float32), joints, captured, (), True)
        assert watcher.judge.judge(seen, watcher.now, None).implausible_reason == ""


def test_a_repeated_sample_is_not_judged_again():
    watcher = stood()
    watcher.see([-0.5, 0.3, 0.05])
    assert all(watcher.see([-0.5, 0.3, 0.05], stamp=False) != "" for _ in range(10))


def test_joints_that_change_under_an_old_stamp_are_judged_as_well():
    # Joints that come in several messages are as old as the oldest of them.
    watcher = stood()
    assert (
        watcher.see([0.0, -0.4, 0.05], stamp=False)
        == "hip read exactly 0 rad after 0.800: is an encoder dead?"
    )
    assert watcher.see([5.0, -0.4, 0.05], stamp=False).startswith("hip reads 5.000 rad, beyond its limits")
    assert watcher.see(STANDS, stamp=False) == ""


def test_after_missing_joints_everything_is_seen_anew_and_zeros_are_named():
    watcher = stood()
    watcher.miss(20)
    assert not watcher.judge.has_known_sample or watcher.see(np.zeros(3)) != ""
    watcher.stand(5, np.zeros(3))
    assert watcher.judge.pop_outage() > 0.5
    assert watcher.judge.pop_outage() == 0.0
    assert watcher.judge.dead == "hip, knee read exactly 0 rad after 0.800, -0.400"


def test_a_stall_of_our_own_is_no_gap_in_the_joints():
    watcher = stood()
    watcher.now += 3.0
    assert watcher.see(STANDS) == ""


def test_a_joint_that_reads_the_same_while_its_command_moves_is_frozen():
    watcher = stood()
    doubts = [
        watcher.see([0.8, -0.4 + 0.002 * tick, 0.05], [0.8 + 0.002 * tick, 0.0, 0.0]) for tick in range(40)
    ]
    assert doubts[:30] == [""] * 30
    assert doubts[-1].startswith("hip has read exactly 0.8000 rad for 1.")
    assert doubts[-1].endswith("s while its command moved 0.08 rad")
    assert watcher.see([0.8, -0.4, 0.05]) == ""  # nothing moves it any more


def test_a_blocked_joint_that_is_noisy_is_not_frozen_and_neither_is_a_gripper_or_one_that_stands():
    watcher = stood()
    for tick in range(90):
        noisy = 0.8 + 1e-6 * (tick % 2)
        assert watcher.see([noisy, -0.4, 0.05], [0.8 + 0.01 * tick, -0.4, 0.1 * (tick % 2)]) == ""


def test_a_joint_that_stood_for_long_and_follows_late_is_not_frozen():
    watcher = stood()
    for _ in range(60):
        assert watcher.see(STANDS, STANDS) == ""
    for tick in range(30):
        late = 0.8 + 0.05 * max(tick - 6, 0)  # 0.2 s behind its command
        assert watcher.see([late, -0.4, 0.05], [0.8 + 0.05 * tick, -0.4, 0.05]) == ""


def test_what_was_seen_is_never_written_to():
    watcher = stood()
    watcher.see(STANDS, STANDS)
    watcher.see(STANDS)
    assert watcher.judge.median_joints(np.zeros(3)) == pytest.approx(STANDS)


def test_a_frozen_joint_may_be_tried_again():
    watcher = stood()
    for tick in range(40):
        watcher.see(STANDS, [0.8 + 0.01 * tick, -0.4, 0.05])
    watcher.see(STANDS)
    assert watcher.see(STANDS, [1.2, -0.4, 0.05]) == ""


def test_an_endless_joint_that_is_counted_in_another_turn_has_not_moved():
    endless = Limits(
        ("wheel", "knee", "gripper"),
        np.array([-np.inf, -2.0, 0.0]),
        np.array([np.inf, 2.0, 0.1]),
        LIMITS.velocity,
        LIMITS.grippers,
        LIMITS.binary,
    )
    watcher = Watcher(endless, DimensionKinds((), (0,)))
    watcher.stand(5, [3.1, 0.0, 0.0])
    assert watcher.see([-3.1, 0.0, 0.0]) == ""


def test_what_moves_no_robot_is_believed_at_once():
    judge = TrustingPlausibility(LIMITS, DimensionKinds())
    seen = LatestObservation(1, STANDS.astype(np.float32), STANDS, 99.0, (), True)
    assert judge.judge(seen, 99.0, None) is seen
    assert judge.is_displaced(np.zeros(3), 0.5)
    assert not judge.is_displaced(STANDS, 0.5)
