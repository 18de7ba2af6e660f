import numpy as np
import pytest

from runtime.processes.control.gripper_locks import GripperLocks
from tests.runtime.tick_bench import WITH_GRIPPER, Bench, following

NAN = float("nan")


def spec_of(gripper, count=60, arm=0.0):
    rows = np.zeros((count, 3))
    rows[:, :2], rows[:, 2] = arm, gripper
    return rows


@pytest.fixture
def bench():
    bench = Bench(limits=WITH_GRIPPER)
    bench.measured = np.array([0.0, 0.0, 0.05])
    return bench


def test_a_locked_dimension_is_replaced_and_noted_where_that_made_a_difference():
    locks = GripperLocks(WITH_GRIPPER)
    assert locks.set(np.array([NAN, NAN, 0.05]), np.zeros(3)) == ""
    action, notes = locks.apply(np.array([0.3, 0.2, 0.1]))
    assert action.tolist() == [0.3, 0.2, 0.05]
    assert notes == ("gripper locked at 0.05",)
    assert locks.apply(np.array([0.3, 0.2, 0.05]))[1] == ()


def test_a_lock_beyond_the_range_is_at_its_end():
    locks = GripperLocks(WITH_GRIPPER)
    assert locks.set(np.array([NAN, NAN, 0.5]), np.zeros(3)) == ""
    assert locks.values[2] == 0.1


def test_an_action_of_another_shape_is_left_to_safety():
    locks = GripperLocks(WITH_GRIPPER)
    locks.set(np.array([NAN, NAN, 0.05]), np.zeros(3))
    assert locks.apply(np.zeros(2))[1] == ()


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (np.array([0.1, NAN, NAN]), "a is no gripper: only grippers are locked"),
        (np.array([NAN, NAN]), "expected float (3,)"),
        (np.array([0, 0, 0]), "expected float"),
    ],
)
def test_what_cannot_be_locked_is_refused_and_changes_nothing(values, said):
    locks = GripperLocks(WITH_GRIPPER)
    assert said in locks.set(values, np.zeros(3))
    assert not locks.on.any()
    assert str(locks) == "every gripper is free"


def test_the_policy_moves_the_arm_and_not_a_locked_gripper(bench):
    bench.lock(NAN, NAN, 0.05)
    following(bench, spec_of(0.1, arm=0.03))
    bench.run(20)
    assert bench.sent[-1] == pytest.approx([0.03, 0.03, 0.05])
    record = bench.records()[-1]
    assert record.notes == ["gripper locked at 0.05"]
    assert record.smoothed[2] == pytest.approx(0.1)  # what was wanted stays on record
    assert bench.status["locked"][2] == pytest.approx(0.05)
    assert np.isnan(bench.status["locked"][:2]).all()
    assert not bench.status["limited"]
    assert [event.text for event in bench.said("locked")] == ["gripper locked at 0.05"]


def test_locking_elsewhere_goes_there_within_the_limits_and_nothing_else_moves(bench):
    bench.say("hold")
    bench.say("motion", goal=np.array([0.0, 0.0, 0.05]))
    bench.run(5)
    bench.lock(NAN, NAN, 0.1)
    bench.run(30)
    way = np.diff(bench.sent[:, 2])
    assert way.max() <= 1.0 * 0.3 * 1.06 / 30  # a motion of ours
    assert way.min() >= -1e-6
    assert bench.sent[-1] == pytest.approx([0.0, 0.0, 0.1], abs=1e-6)


def test_unlocking_moves_nothing_by_itself(bench):
    following(bench, spec_of(0.05))
    bench.say("hold", run=1)
    bench.run(5)
    bench.lock(NAN, NAN, 0.1)
    bench.run(30)
    bench.lock(NAN, NAN, NAN)
    bench.run(10)
    assert (bench.sent[-9:, 2] == bench.sent[-10, 2]).all()
    assert bench.sent[-1, 2] == pytest.approx(0.1)


def test_unlocking_under_a_policy_lets_it_have_the_gripper_within_the_limits(bench):
    bench.lock(NAN, NAN, 0.05)
    following(bench, spec_of(0.1))
    bench.run(9)
    bench.lock(NAN, NAN, NAN)
    bench.run(20)
    assert np.diff(bench.sent[:, 2]).max() <= 1.0 / 30 + 1e-6
    assert bench.sent[-1, 2] == pytest.approx(0.1)


def test_a_motion_with_a_locked_gripper_still_arrives(bench):
    bench.lock(NAN, NAN, 0.05)
    bench.say("motion", goal=np.array([0.3, 0.0, 0.1]))
    bench.run(60)
    assert [event.kind for event in bench.said()] == ["locked", "motion_done"]
    assert bench.sent[-1] == pytest.approx([0.3, 0.0, 0.05], abs=1e-3)


def test_a_gripper_locked_and_unlocked_in_the_middle_of_a_motion_never_jumps(bench):
    bench.say("motion", goal=np.array([0.8, 0.0, 0.1]))
    bench.run(15)
    bench.lock(NAN, NAN, 0.0)
    bench.run(15)
    bench.lock(NAN, NAN, NAN)
    bench.run(120)
    assert np.abs(np.diff(bench.sent[:, 2])).max() <= 1.0 / 30 + 1e-6
    assert bench.sent[-1] == pytest.approx([0.8, 0.0, 0.1], abs=1e-3)


def test_the_e_stop_knows_of_no_lock(bench):
    following(bench, spec_of(0.05))
    bench.run(5)
    bench.shared.set_estop(2)
    bench.lock(NAN, NAN, 0.1)
    bench.run(10)
    assert (bench.sent[-10:, 2] == bench.sent[-11, 2]).all()


def test_locks_that_are_none_are_said_and_control_goes_on(bench):
    following(bench, spec_of(0.05))
    bench.lock(0.5, NAN, NAN)
    bench.run(3)
    assert "a is no gripper" in bench.said("lock_refused")[0].text
    assert len(bench.sink.sent) == 4
