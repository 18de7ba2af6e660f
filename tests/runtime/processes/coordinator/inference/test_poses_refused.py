"""Poses that joints miss by far are refused: they would be driven to as near as can be, as fast as joints may."""

from __future__ import annotations

import numpy as np
import pytest

from robots import load_robot
from runtime.core.clock import VirtualClock
from runtime.core.errors import PolicyError
from runtime.core.types import ActionChunk, Conditioning, Observation
from runtime.kinematics.compiled import CompiledKinematics
from runtime.policies.base import Policy, PolicyInfo
from runtime.processes.coordinator.inference.requests import MissBound, PolicyRequests, PolicyResponse
from runtime.processes.coordinator.inference.runners import LockstepRunner
from runtime.spaces.conversion import ActionSpaces

ROBOT = load_robot("agilex_piper")
SPACES = ActionSpaces(ROBOT, CompiledKinematics(ROBOT), 30.0)
START = np.asarray(ROBOT.poses["ready"], np.float64)
BOUND = MissBound(0.02, 0.2, 0.5)


class Answers(Policy):
    """Answers with these poses."""

    def __init__(self, rows: np.ndarray) -> None:
        self.rows = rows

    def connect(self) -> PolicyInfo:
        return PolicyInfo("answers")

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        return ActionChunk(self.rows.astype(np.float32), "eef")

    def reset(self) -> None: ...

    def close(self) -> None: ...


class Eyes:
    """Sees the robot where it was `at` step 100; control has commanded `passed` steps since."""

    def __init__(self, passed: int) -> None:
        self.passed = passed

    def latest(self, task: str, pictures: bool = True) -> Observation:
        return Observation(1, 0.0, {"joints": 0.0}, START.astype(np.float32), {}, step=100)

    def commanded(self) -> tuple[int, np.ndarray] | None:
        return 100 + self.passed, START

    def use_simulated(self, simulated: bool) -> None: ...


def asked(rows: np.ndarray, first: bool, bound: MissBound | None = BOUND, passed: int = 0) -> PolicyResponse:
    """The answer of these rows, the first of a run or a later one."""
    policy, eyes, clock = Answers(rows), Eyes(passed), VirtualClock(0.0)
    requests = PolicyRequests(policy, "pick", SPACES, eyes, LockstepRunner(0), clock, bound)
    if not first:
        policy.rows = near(4)
        requests.send(executed=True).result()
        policy.rows = rows
    answered = requests.send(executed=True).result()
    requests.log_ik_problems(answered)
    assert bool(answered.refused) == ("poses_refused" in [note.kind for note in requests.notes])
    return answered


def near(count: int) -> np.ndarray:
    """Poses that go slowly upwards from where the robot is."""
    rows = np.repeat(SPACES.eef_of(START)[None], count, axis=0).astype(np.float64)
    rows[:, [2, 10]] += 0.001 * np.arange(1, count + 1)[:, None]
    return rows


def in_millimetres(count: int) -> np.ndarray:
    rows = near(count)
    rows[:, [0, 1, 2]] *= 1000.0
    return rows


def test_a_later_answer_that_begins_far_away_is_refused_by_name() -> None:
    with pytest.raises(
        PolicyError, match=r"row 1 of the answer is a pose of left_arm that no joints .* not in metres"
    ):
        asked(in_millimetres(20), first=False)


@pytest.mark.parametrize("first", [True, False])
def test_rows_before_the_first_that_is_missed_are_executed(first: bool) -> None:
    answered = asked(np.concatenate([near(10), in_millimetres(10)]), first)
    assert len(answered.commands.rows) == len(answered.commands.source_rows) == 10
    assert answered.commands.ik_result is not None
    assert len(answered.commands.ik_result.flags) == 10
    assert "row 10 of the answer" in answered.refused
    assert np.abs(answered.commands.rows - START).max() < 0.1


@pytest.mark.parametrize("first", [True, False])
def test_a_first_answer_is_no_licence(first: bool) -> None:
    """Its first row may be near, and none of its poses be met."""
    rows = near(20)
    rows[1:, [8, 9, 10]] *= 1000.0
    if first:
        assert len(asked(rows, first, passed=-1).commands.rows) == 1
    else:
        with pytest.raises(PolicyError, match="right_arm that no joints meet"):
            asked(rows, first)


def shifted(joint: float, count: int) -> np.ndarray:
    """Poses of where both arms are when their first joints are that far away."""
    there = START.copy()
    there[[0, 7]] += joint
    return np.repeat(SPACES.eef_of(there)[None], count, axis=0).astype(np.float64)


@pytest.mark.parametrize("first", [True, False])
def test_joints_that_lag_behind_by_less_than_a_jump_are_held_back_as_those_of_joint_rows_are(
    first: bool,
) -> None:
    assert asked(shifted(0.45, 20), first).refused == ""


def test_where_a_run_begins_farther_away_control_says_it_by_its_first_row() -> None:
    answered = asked(shifted(0.9, 20), first=True, passed=-1)
    assert len(answered.commands.rows) == 1
    assert answered.commands.first is not None
    assert np.abs(answered.commands.intended_start - START).max() == pytest.approx(0.9, abs=0.01)


def test_a_later_answer_that_begins_farther_away_is_refused() -> None:
    with pytest.raises(
        PolicyError, match=r"row 1 of the answer is a pose that is 0\.\d+ rad from where the joints"
    ):
        asked(shifted(0.9, 20), first=False)


def test_stale_rows_do_not_count() -> None:
    rows = near(20)
    rows[:3] = in_millimetres(3)
    assert asked(rows, first=False, passed=3).refused == ""


def test_a_deployment_may_have_them_flagged_alone() -> None:
    answered = asked(in_millimetres(20), first=False, bound=None)
    assert len(answered.commands.rows) == 20
    assert answered.ik["over"] > 0


def test_who_only_looks_sees_all_of_it() -> None:
    """A set-up asks twice, and compares where the policy means to begin."""
    requests = PolicyRequests(
        Answers(in_millimetres(20)), "pick", SPACES, Eyes(0), LockstepRunner(0), VirtualClock(0.0), BOUND
    )
    for _ in range(2):
        answered = requests.send().result()
        assert (len(answered.commands.rows), answered.refused) == (20, "")


def test_the_arm_is_named() -> None:
    rows = near(20)
    rows[5:, 8] += 0.5
    assert "a pose of right_arm" in asked(rows, first=False).refused
