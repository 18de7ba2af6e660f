"""Chunks whose poses have been missed, planned again from their end."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.ik_paths import ROWS, arm_dims
from benchmarks.ik_postures import followed, path, worst
from robots import load_robot
from runtime.kinematics import compiled
from runtime.kinematics.base import IkFlag, IkResult
from runtime.kinematics.compiled import CompiledKinematics
from runtime.kinematics.replanning import arms_missing_targets, replan, sample_postures

ARX = load_robot("arx_r5")
KINEMATICS = CompiledKinematics(ARX)
FRANKA = load_robot("dual_franka")
SEVEN = CompiledKinematics(FRANKA)
DT = 1 / ARX.control_rate
JOINTS = path(ARX, 47, 1)  # comes by a singularity at once, behind which one of two branches ends at a limit


def result_of(reached: list[list[bool]]) -> IkResult:
    flags = np.where(np.array(reached), 0, int(IkFlag.OVER_TOLERANCE)).astype(np.uint8)
    return IkResult(np.zeros((len(flags), 2)), np.zeros(flags.shape), np.zeros(flags.shape), flags)


def test_an_arm_that_meets_its_first_pose_and_misses_a_later_one_is_planned_again() -> None:
    rows = [[False, True, True], [True, True, False], [True, False, False]]
    assert arms_missing_targets(result_of(rows), 0).tolist() == [1, 2]
    assert arms_missing_targets(result_of(rows), 1).tolist() == [1]
    assert arms_missing_targets(result_of(rows), 2).tolist() == []
    assert arms_missing_targets(result_of(rows), 3).tolist() == []


def test_postures_are_home_and_others_within_limits_and_the_same_each_time() -> None:
    lower, upper = np.array([-1.0, -np.inf]), np.array([2.0, np.inf])
    made = sample_postures(np.array([0.5, 0.1]), lower, upper, 40)
    np.testing.assert_array_equal(made[0], [0.5, 0.1])
    assert made.shape == (41, 2)
    assert ((made >= [-1, -np.pi]) & (made <= [2, np.pi])).all()
    np.testing.assert_array_equal(made, sample_postures(np.array([0.5, 0.1]), lower, upper, 40))


@pytest.mark.parametrize("anchor", [JOINTS[0], None])
def test_a_branch_that_ends_at_a_limit_is_left_for_the_other(
    monkeypatch: pytest.MonkeyPatch, anchor: np.ndarray | None
) -> None:
    targets = KINEMATICS.forward(JOINTS)
    found = KINEMATICS.solve(targets, JOINTS[0], DT, anchor, 0)
    assert found.reached.all()
    assert found.position_error.max() < 1e-5
    monkeypatch.setattr(compiled, "replan", lambda *_: None)
    alone = KINEMATICS.solve(targets, JOINTS[0], DT, anchor, 0)
    assert alone.position_error[:, 0].max() > 0.02
    right = ARX.arms[1].joint_dims  # which missed nothing
    np.testing.assert_array_equal(found.q[:, right], alone.q[:, right])


def test_rows_before_the_first_that_is_executed_stay_as_they_were(monkeypatch: pytest.MonkeyPatch) -> None:
    stale = np.repeat(JOINTS[:1], 5, axis=0)
    targets = KINEMATICS.forward(np.concatenate([stale, JOINTS]))
    found = KINEMATICS.solve(targets, JOINTS[0], DT, JOINTS[0], 5)
    assert found.reached.all()
    monkeypatch.setattr(compiled, "replan", lambda *_: None)
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
    assert replan(sweep, targets, ARX.poses["home"], DT, dims, starts, lambda q: np.inf) is None
    assert len(asked) == 4
    assert all(len(poses) == 1 for poses in asked)


@pytest.mark.parametrize("number", [9, 55])
def test_a_chunk_that_ends_by_a_limit_has_another_posture_so_that_the_next_ones_are_met(
    monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """The elbow is stretched to 0.2 rad by poses that it meets at 0.5 too, and those that come stretch it farther."""
    joints = path(FRANKA, number)
    assert worst(FRANKA, SEVEN, joints, ROWS).max() < 1e-3
    q = followed(SEVEN, FRANKA, SEVEN.forward(joints), joints[0], ROWS).q
    assert (np.abs(np.diff(q, axis=0)) <= FRANKA.velocity / FRANKA.control_rate + 1e-9).all()
    monkeypatch.setattr(compiled, "MIN_LIMIT_MARGIN", -np.inf)
    assert worst(FRANKA, SEVEN, joints, ROWS).max() > 15e-3


@pytest.mark.parametrize("number", [206, 202])  # missed by 115 and 77 mm while the posture goes home
def test_a_path_that_going_home_leads_away_from_is_met_by_a_posture_that_stays(
    monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    joints = path(FRANKA, number, 1, np.inf)
    q = followed(SEVEN, FRANKA, SEVEN.forward(joints), joints[0], len(joints)).q
    assert worst(FRANKA, SEVEN, joints).max() < 1e-3
    assert (np.abs(np.diff(q, axis=0)) <= FRANKA.velocity / FRANKA.control_rate + 1e-9).all()
    swept = SEVEN._solve_rows
    monkeypatch.setattr(SEVEN, "_solve_rows", lambda *given, home_rate=None, **named: swept(*given, **named))
    assert worst(FRANKA, SEVEN, joints).max() > 50e-3


def test_room_is_that_of_the_nearest_limit_and_none_is_missed_where_home_has_less_or_there_is_no_choice() -> (
    None
):
    arm, dims = SEVEN._arms[0], FRANKA.arms[0].joint_dims
    q = FRANKA.poses["home"].copy()
    q[dims[3]] = FRANKA.upper[dims[3]] - 0.2
    assert compiled._limit_margin(arm, q) == pytest.approx(0.25)
    near_home = arm.copy()
    near_home["above"][3] = 0.1
    assert compiled._limit_margin(near_home, q) > 0.25
    assert compiled._limit_margin(KINEMATICS._arms[0], ARX.lower) == np.inf
