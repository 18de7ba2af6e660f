import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import robots
from runtime.safety.collision import Collisions
from runtime.safety.filter import Limits, RobotState, SafetyFilter, SafetySettings
from tests.examples import some
from tests.runtime.collision_samples import collisions, robot, turned

NAMES = ("arm.joint0", "arm.joint1", "arm.gripper")
LIMITS = Limits(
    names=NAMES,
    lower=np.array([-1.0, 0.0, 0.0]),
    upper=np.array([1.0, 3.0, 0.1]),
    velocity=np.array([3.0, 3.0, 1.0]),
    grippers=np.array([False, False, True]),
    binary=np.zeros(3, bool),
)
DT = 1 / 30


def state(previous=(0.0, 1.0, 0.05), velocity=(0.0, 0.0, 0.0), measured=None, **changes) -> RobotState:
    previous = np.array(previous, float)
    measured = previous if measured is None else np.array(measured, float)
    return RobotState(previous, np.array(velocity, float), measured, changes.pop("elapsed", DT), **changes)


def judge(action, where=None, path="policy", limits=LIMITS, outside=None, **options):
    return SafetyFilter(SafetySettings(**options), limits, outside).judge(
        np.array(action, float), where or state(), path
    )


def test_a_reachable_action_passes_unchanged_to_the_last_bit():
    action = np.array([0.01, 1.01, 0.051])
    verdict = judge(action)
    assert (verdict.action == action).all()
    assert verdict.notes == ()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_it_refuses_what_is_not_finite_and_names_the_joint(value):
    verdict = judge([0.0, value, 0.0])
    assert verdict.refused
    assert "arm.joint1" in verdict.notes[0]


def test_it_refuses_a_wrong_dimension():
    assert "shape (2,), expected (3,)" in judge([0.0, 0.0]).notes[0]


def test_it_refuses_on_old_joints_and_on_old_pictures_each_by_its_own_bound():
    assert (
        "joint readings are 0.25 s old (limit 0.2 s)" in judge([0, 1, 0.05], state(joint_age=0.25)).notes[0]
    )
    assert not judge([0, 1, 0.05], state(picture_ages={"cam": 0.25})).refused
    assert "picture cam is 0.60 s old" in judge([0, 1, 0.05], state(picture_ages={"cam": 0.6})).notes[0]
    assert judge([0, 1, 0.05], state(picture_ages={"cam": float("nan")})).refused


def test_a_motion_of_ours_needs_no_pictures():
    assert not judge([0, 1, 0.05], state(picture_ages={"cam": 9.0}), path="motion").refused


def test_a_motion_of_ours_is_not_made_blind_nor_against_a_blocked_arm():
    old = judge([0, 1, 0.05], state(joint_age=0.25), path="motion")
    assert "joint readings are 0.25 s old (limit 0.2 s)" in old.notes[0]
    blocked = state(previous=(0.5, 1, 0.05), measured=(0.0, 1, 0.05))
    assert "from where it is measured" in judge([0.51, 1, 0.05], blocked, path="motion").notes[0]
    assert not judge([0.45, 1, 0.05], blocked, path="motion").refused


def test_a_joint_that_comes_back_does_not_hide_another_one_that_runs_away():
    both = state(previous=(0.8, 1.55, 0.05), measured=(0.0, 1.0, 0.05))
    verdict = judge([0.7, 1.6, 0.05], both)
    assert verdict.refused
    assert "arm.joint1 would be 0.60 rad" in verdict.notes[0]


def test_a_joint_that_is_measured_as_nan_refuses_every_action():
    assert judge([0, 1, 0.05], state(measured=(np.nan, 1, 0.05))).refused
    assert judge([0, 1, 0.05], state(measured=(np.nan, 1, 0.05)), path="motion").refused


def test_a_target_never_runs_away_from_a_blocked_arm_but_may_come_back():
    blocked = state(previous=(0.6, 1, 0.05), measured=(0.0, 1, 0.05))
    assert "from where it is measured" in judge([0.62, 1, 0.05], blocked).notes[0]
    assert not judge([0.55, 1, 0.05], blocked).refused


def test_it_refuses_a_jump():
    assert "jumps 0.60 rad" in judge([0.0, 1.6, 0.05], state(measured=(0, 1.3, 0.05))).notes[0]


def test_a_workspace_box_refuses_and_never_clamps():
    verdict = judge([0, 1, 0.05], outside=lambda action: ("left_arm",))
    assert verdict.refused
    assert "left_arm would leave the workspace box" in verdict.notes


def test_velocity_is_limited_and_the_note_says_from_what_to_what():
    verdict = judge([0.0, 1.4, 0.05], state(velocity=(0, 3.0, 0)))
    assert verdict.action[1] == pytest.approx(1 + 3.0 * DT)
    assert verdict.notes == ("arm.joint1 limited from 1.4000 to 1.1000",)


def test_a_gripper_beyond_its_range_is_brought_back_into_it():
    verdict = judge([0, 1, 0.103], state(previous=(0, 1, 0.1)))
    assert verdict.action[2] == pytest.approx(0.1)


def test_a_binary_gripper_switches_at_once():
    limits = Limits(
        LIMITS.names, LIMITS.lower, LIMITS.upper, LIMITS.velocity, LIMITS.grippers, LIMITS.grippers
    )
    verdict = judge([0, 1, 0.1], state(previous=(0, 1, 0.0)), limits=limits)
    assert verdict.action[2] == 0.1
    assert verdict.notes == ()


def test_report_only_sends_the_action_as_it_is_and_lists_what_it_would_have_done():
    verdict = judge([0, 1, 0.103], report_only=True, where=state(previous=(0, 1, 0.1)))
    assert verdict.action[2] == 0.103
    assert "arm.gripper 0.1030 is outside 0..0.1" in verdict.notes


def test_report_only_lists_what_is_beyond_a_limit_also_where_it_would_have_refused():
    verdict = judge([0, 1, 0.103], state(joint_age=9.0), report_only=True)
    assert "joint readings are 9.00 s old (limit 0.2 s)" in verdict.notes
    assert "arm.gripper 0.1030 is outside 0..0.1" in verdict.notes


def test_report_only_still_refuses_what_cannot_be_sent():
    assert judge([np.nan, 0, 0], report_only=True).refused


def test_an_arm_that_starts_outside_its_limits_may_stay_or_come_back_but_not_go_further():
    outside = state(previous=(0, -0.02, 0.05))
    assert not judge([0, -0.02, 0.05], outside).refused
    assert not judge([0, 0.0, 0.05], outside).refused
    verdict = judge([0, -0.05, 0.05], outside)
    assert verdict.refused or verdict.action[1] >= -0.02 - 1e-9


@settings(max_examples=some(60))
@given(
    st.lists(st.floats(-5, 5), min_size=30, max_size=120),
    st.lists(st.floats(0.2, 1.5), min_size=120, max_size=120),
    st.floats(2.0, 60.0),
)
def test_whatever_is_asked_the_limits_hold_together(asked, stretches, acceleration):
    """Velocity, acceleration and joint limits at once, at changing tick lengths: none undoes another."""
    limits = Limits(
        ("j",), np.array([-1.0]), np.array([1.0]), np.array([3.0]), np.zeros(1, bool), np.zeros(1, bool)
    )
    options = SafetySettings(acceleration=acceleration, jump=100.0, following_error=100.0)
    safety = SafetyFilter(options, limits)
    previous, velocity = np.zeros(1), np.zeros(1)
    for target, stretch in zip(asked, stretches, strict=False):
        dt = DT * stretch
        verdict = safety.judge(np.array([target]), RobotState(previous, velocity, previous, dt))
        assert not verdict.refused
        new = (verdict.action - previous) / dt
        assert abs(new[0]) <= 3.0 + 1e-4
        assert abs(new[0] - velocity[0]) <= acceleration * dt + 1e-4
        assert -1.0 - 1e-6 <= verdict.action[0] <= 1.0 + 1e-6
        previous, velocity = verdict.action, new


# --- a target that jumped ------------------------------------------------------------------------------------

ONE = Limits(("j",), np.array([-9.0]), np.array([9.0]), np.array([3.0]), np.zeros(1, bool), np.zeros(1, bool))


def followed(targets, dt, **options):
    """What is sent for targets [N], one per tick of `dt` s, from rest at 0; and the notes of each tick."""
    safety = SafetyFilter(SafetySettings(**({"jump": 20.0, "following_error": 20.0} | options)), ONE)
    previous, velocity, aim, sent, notes = np.zeros(1), np.zeros(1), None, [], []
    for target in targets:
        action = np.array([target], float)
        verdict = safety.judge(action, RobotState(previous, velocity, previous, dt, previous_target=aim))
        velocity, previous, aim = (verdict.action - previous) / dt, verdict.action, action
        sent.append(previous[0])
        notes.append(verdict.notes)
    return np.array(sent), notes


@settings(max_examples=some(60))
@given(st.floats(-0.5, 0.5), st.sampled_from([30.0, 50.0, 100.0, 200.0]))
def test_a_target_that_jumped_is_reached_without_going_beyond_it(jump, rate):
    sent, _ = followed([jump] * int(rate), 1 / rate)
    assert (np.abs(sent) <= abs(jump) + 1e-5).all()
    assert sent[-1] == pytest.approx(jump, abs=1e-5)


@settings(max_examples=some(60))
@given(st.floats(-0.4, 0.4), st.floats(-2.0, 2.0), st.sampled_from([50.0, 100.0, 200.0]))
@example(0.015625, -2.0, 200.0)
def test_a_moving_target_that_jumped_is_caught_up_with_and_then_kept(jump, speed, rate):
    """Whoever is behind arrives at the target's own speed: not beyond it, and not later and later."""
    time = np.arange(int(rate)) / rate
    behind = followed(jump + speed * time, 1 / rate)[0] - (jump + speed * time)
    assert np.abs(behind[-5:]).max() < 1e-5
    beyond = -np.sign(behind[0]) * behind if abs(behind[0]) > 1e-3 else -np.abs(behind)
    known = abs(speed) * 2 / rate  # the target's speed is known from its second action on
    # A target that comes towards who is behind is past him before he has its speed, at 60 rad/s2.
    turning = (abs(speed) + 2 * 60.0 / rate) ** 2 / (2 * 60.0) if jump * speed < 0 else 0.0
    assert beyond.max() < known + turning + 1e-5


def test_what_the_limits_allow_is_followed_to_the_last_bit_whatever_was_wanted_before():
    time = np.arange(200) / 100.0
    targets = 0.4 * (1 - np.cos(3.0 * time))
    sent, notes = followed(targets, 0.01)
    assert (sent == targets).all()
    assert not any(notes)


def test_a_verdict_names_what_was_changed_most():
    verdict = judge([0.3, 1.02, 0.05], state())
    assert verdict.largest_change_note == "arm.joint0 limited from 0.3000 to 0.0667"
    assert verdict.change == pytest.approx(0.3 - 60.0 * DT**2)
    assert judge([0.01, 1.0, 0.05]).largest_change_note == ""


def test_a_motion_that_is_too_fast_for_a_limit_brakes_as_hard_as_a_policy_may():
    """Its own deceleration is soft; the joint limit is not."""
    near = state(previous=(0.98, 1.0, 0.05), velocity=(0.7, 0, 0))
    verdict = judge([1.4, 1.0, 0.05], near, path="motion")
    assert not verdict.refused
    assert verdict.action[0] <= 1.0
    assert verdict.action[0] >= 0.98


def test_the_box_is_not_asked_twice_about_an_action_that_was_not_changed():
    asked = []
    judge([0.01, 1.0, 0.05], outside=lambda action: asked.append(action.copy()) or ())
    assert len(asked) == 2  # the action, and where the arm would come to a stand after it
    asked.clear()
    judge([0.3, 1.0, 0.05], outside=lambda action: asked.append(action.copy()) or ())
    assert len(asked) == 3


# --- collisions -----------------------------------------------------------------------------------------------


def arms(action, previous, path="policy", measured=None, **options):
    """The verdict on a step of the two Pipers that stand beside each other."""
    own = robot()
    grippers = np.isin(np.arange(own.dim), own.gripper_dims)
    limits = Limits(own.joint_names, own.lower, own.upper, own.velocity, grippers, np.zeros(own.dim, bool))
    where = RobotState(previous, np.zeros(own.dim), previous if measured is None else measured, DT)
    return SafetyFilter(SafetySettings(**options), limits, None, collisions()).judge(action, where, path)


def inwards(by):
    """A step further inwards that velocity and acceleration allow."""
    return by + 0.02


def test_by_default_a_step_into_the_other_arm_is_sent_and_warned_of():
    action = turned(inwards(1.2))
    verdict = arms(action, turned(1.2))
    assert np.array_equal(verdict.action, action)
    assert verdict.near_collision is not None
    assert verdict.notes == (str(verdict.near_collision),)
    assert arms(turned(inwards(0.5)), turned(0.5)).near_collision is None


def test_where_collisions_are_refused_such_a_step_is_and_one_that_parts_is_not():
    refused = arms(turned(inwards(1.2)), turned(1.2), collision="refuse")
    assert refused.refused
    assert "left_arm/" in refused.notes[0]
    assert "deep)" in refused.notes[0]
    assert not arms(turned(1.18), turned(1.2), collision="refuse").refused
    assert not arms(turned(1.2), turned(1.2), collision="refuse").refused
    assert arms(turned(1.18), turned(1.2), collision="refuse").near_collision is None


def test_an_arm_that_could_not_stop_before_the_other_is_refused_while_there_is_room():
    own = robot()
    fast = np.zeros(own.dim)
    fast[[0, 7]] = -3.0, 3.0
    grippers = np.isin(np.arange(own.dim), own.gripper_dims)
    limits = Limits(own.joint_names, own.lower, own.upper, own.velocity, grippers, np.zeros(own.dim, bool))
    judging = SafetyFilter(SafetySettings(collision="refuse"), limits, None, collisions())
    before, action = turned(0.75), turned(0.85)
    assert collisions().closer_pair(action, before) is None
    quick = judging.judge(action, RobotState(before, fast, before, DT))
    assert quick.refused
    assert "right_arm/" in quick.notes[-1]
    assert not judging.judge(turned(0.76), RobotState(before, fast / 10, before, DT)).refused


def test_motions_of_ours_are_refused_even_where_policies_are_not_judged():
    for mode in ("off", "warn", "refuse"):
        assert arms(turned(inwards(1.2)), turned(1.2), path="motion", collision=mode).refused
        assert not arms(turned(1.19), turned(1.2), path="motion", collision=mode).refused
    off = arms(turned(inwards(1.2)), turned(1.2), collision="off")
    assert (off.refused, off.near_collision, off.notes) == (False, None, ())


def test_report_only_tells_of_a_collision_and_sends_the_action():
    action = turned(inwards(1.2))
    told = arms(action, turned(1.2), report_only=True, collision="refuse")
    assert np.array_equal(told.action, action)
    assert "deep)" in told.notes[0]
    assert arms(action, turned(1.2), report_only=True).near_collision is not None


def test_a_collision_is_judged_after_the_box_and_before_the_following_error():
    far = turned(1.2)
    far[1] -= 0.9
    action = turned(inwards(1.2))
    verdict = arms(action, turned(1.2), measured=far, collision="refuse")
    assert "deep)" in verdict.notes[0]
    assert "from where it is measured" in arms(action, turned(1.2), measured=far, collision="off").notes[0]


def test_a_motion_of_ours_may_come_from_outside_its_box_and_not_go_there():
    """Where the first joint is beyond 0.05 the arm is outside."""

    def outside(action):
        return ("left_arm",) if (action[..., 0] > 0.05).any() else ()

    left = judge([0.06, 1, 0.05], state(previous=(0.04, 1, 0.05)), path="motion", outside=outside)
    assert left.notes == ("left_arm would leave the workspace box",)
    for there in (0.05, 0.1, 0.11):
        back = judge([there, 1, 0.05], state(previous=(0.1, 1, 0.05)), path="motion", outside=outside)
        assert not back.refused


# --- robots of every kind -----------------------------------------------------------------------------------


@pytest.mark.some(4)
@pytest.mark.parametrize("name", robots.robot_names())
@pytest.mark.parametrize("path", ["policy", "motion"])
def test_every_robot_may_stand_at_its_poses_and_move_from_them_within_its_limits(name, path):
    own = robots.load_robot(name)
    grippers = np.isin(np.arange(own.dim), own.gripper_dims)
    binary = np.isin(np.arange(own.dim), own.binary_dims)
    limits = Limits(own.joint_names, own.lower, own.upper, own.velocity, grippers, binary)
    judging = SafetyFilter(SafetySettings(collision="refuse"), limits, None, Collisions(own, 0.005))
    for pose in own.poses.values():
        where = RobotState(pose, np.zeros(own.dim), pose, DT)
        assert np.array_equal(judging.judge(pose.copy(), where, path).action, pose)
        jump = np.where(grippers, np.where(pose == own.upper, own.lower, own.upper), pose)
        verdict = judging.judge(jump, where, path)
        assert not verdict.refused  # a gripper's whole travel is no jump, whatever its unit
        assert np.array_equal(verdict.action[binary], jump[binary])
        travel = np.abs(verdict.action - pose)[grippers & ~binary]
        assert (travel <= (own.velocity * DT)[grippers & ~binary] + 1e-9).all()
        assert (travel > 0).all()
