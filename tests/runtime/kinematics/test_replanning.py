"""Chunks whose poses have been missed, planned again from their end."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.ik_paths import arm_dims
from benchmarks.ik_postures import path
from robots import load
from runtime.kinematics import compiled
from runtime.kinematics.base import IkFlag, IkResult
from runtime.kinematics.compiled import CompiledKinematics
from runtime.kinematics.replanning import missed, postures, replanned

ARX = load("arx_r5")
KINEMATICS = CompiledKinematics(ARX)
DT = 1 / ARX.control_rate
JOINTS = path(ARX, 47, 1)  # comes by a singularity at once, behind which one of two branches ends at a limit


def result_of(reached: list[list[bool]]) -> IkResult:
    flags = np.where(np.array(reached), 0, int(IkFlag.OVER_TOLERANCE)).astype(np.uint8)
    return IkResult(np.zeros((len(flags), 2)), np.zeros(flags.shape), np.zeros(flags.shape), flags)


def test_an_arm_that_meets_its_first_pose_and_misses_a_later_one_is_planned_again() -> None:
    rows = [[False, True, True], [True, True, False], [True, False, False]]
    assert missed(result_of(rows), 0).tolist() == [1, 2]
    assert missed(result_of(rows), 1).tolist() == [1]
    assert missed(result_of(rows), 2).tolist() == []
    assert missed(result_of(rows), 3).tolist() == []


def test_postures_are_home_and_others_within_limits_and_the_same_each_time() -> None:
    lower, upper = np.array([-1.0, -np.inf]), np.array([2.0, np.inf])
    made = postures(np.array([0.5, 0.1]), lower, upper, 40)
    np.testing.assert_array_equal(made[0], [0.5, 0.1])
    assert made.shape == (41, 2)
    assert ((made >= [-1, -np.pi]) & (made <= [2, np.pi])).all()
    np.testing.assert_array_equal(made, postures(np.array([0.5, 0.1]), lower, upper, 40))


@pytest.mark.parametrize("anchor", [JOINTS[0], None])
def test_a_branch_that_ends_at_a_limit_is_left_for_the_other(
    monkeypatch: pytest.MonkeyPatch, anchor: np.ndarray | None
) -> None:
    targets = KINEMATICS.forward(JOINTS)
    found = KINEMATICS.solve(targets, JOINTS[0], DT, anchor, 0)
    assert found.reached.all()
    assert found.position_error.max() < 1e-5
    monkeypatch.setattr(compiled, "replanned", lambda *_: None)
    alone = KINEMATICS.solve(targets, JOINTS[0], DT, anchor, 0)
    assert alone.position_error[:, 0].max() > 0.02
    right = ARX.arms[1].joint_dims  # which missed nothing
    np.testing.assert_array_equal(found.q[:, right], alone.q[:, right])


def test_rows_before_the_first_that_is_executed_stay_as_they_were(monkeypatch: pytest.MonkeyPatch) -> None:
    stale = np.repeat(JOINTS[:1], 5, axis=0)
    targets = KINEMATICS.forward(np.concatenate([stale, JOINTS]))
    found = KINEMATICS.solve(targets, JOINTS[0], DT, JOINTS[0], 5)
    assert found.reached.all()
    monkeypatch.setattr(compiled, "replanned", lambda *_: None)
    alone = KINEMATICS.solve(targets, JOINTS[0], DT, JOINTS[0], 5)
    np.testing.assert_array_equal(found.q[:5], alone.q[:5])


def test_where_the_last_pose_is_out_of_reach_no_more_than_a_few_postures_are_tried() -> None:
    asked: list[np.ndarray] = []

    def sweep(poses: np.ndarray, seed: np.ndarray, *_: object) -> IkResult:
        asked.append(poses)
        return result_of([[False]])

    starts = np.zeros((25, 6))
    targets = KINEMATICS.forward(JOINTS)[:, :1]
    dims = arm_dims(ARX)[:6]
    assert replanned(sweep, targets, ARX.poses["home"], DT, dims, starts) is None
    assert len(asked) == 4
    assert all(len(poses) == 1 for poses in asked)
