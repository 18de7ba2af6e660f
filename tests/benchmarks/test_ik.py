"""The chunks that the benchmark of inverse kinematics solves, and what it makes of the solutions."""

from __future__ import annotations

import math
import time
from functools import cache
from typing import Any

import numpy as np
import pytest

from benchmarks.ik import _Call, _case, _compared, _enough, _figures
from benchmarks.ik_paths import CHUNKS, OUT_OF_REACH, ROWS, Chunk, arm_dims, invented
from benchmarks.ik_postures import path, worst
from robots import Robot, load_robot
from runtime.kinematics.base import IkFlag, IkResult, Kinematics

ROBOT = load_robot("agilex_piper")
DIMS = arm_dims(ROBOT)


@cache
def chunks() -> dict[str, list[Chunk]]:
    return invented(ROBOT)


class Guess(Kinematics):
    """Answers every chunk with the same joints."""

    def __init__(self, result: IkResult) -> None:
        self._result = result
        self.asked = 0

    def forward(self, q: np.ndarray) -> np.ndarray:
        raise AssertionError("the benchmark solves alone")

    def solve(
        self,
        targets: np.ndarray,
        seed: np.ndarray,
        dt: float | None = None,
        anchor: np.ndarray | None = None,
        anchor_row: int = 0,
    ) -> IkResult:
        assert anchor is seed
        assert anchor_row == 0
        self.asked += 1
        return self._result


class Slow(Guess):
    """Takes its time for it."""

    def solve(self, *asked: Any, **more: Any) -> IkResult:
        time.sleep(0.01)
        return super().solve(*asked, **more)


def guess(q: np.ndarray, away: float, flags: int = 0) -> Guess:
    shape = (len(q), 2)
    return Guess(IkResult(q, np.full(shape, away), np.full(shape, 0.0), np.full(shape, flags, np.uint8)))


@pytest.mark.some(1)
@pytest.mark.parametrize("kind", ["smooth", "singular", "through", OUT_OF_REACH])
def test_every_kind_has_chunks_of_all_arms_that_begin_where_their_seed_is(kind: str) -> None:
    assert len(chunks()[kind]) == CHUNKS
    for chunk in chunks()[kind]:
        assert chunk.targets.shape == (ROWS, 2, 7)
        assert chunk.reachable == (kind != OUT_OF_REACH)
        assert ((chunk.seed >= ROBOT.lower) & (chunk.seed <= ROBOT.upper)).all()
        for index, arm in enumerate(ROBOT.arms):
            np.testing.assert_allclose(chunk.targets[0, index], arm.pose(chunk.seed), atol=1e-12)


def test_no_two_chunks_are_the_same_and_those_out_of_reach_leave_by_more_than_a_metre() -> None:
    assert len({chunk.seed.tobytes() for chunk in chunks()["smooth"]}) == CHUNKS
    away = chunks()[OUT_OF_REACH][0].targets[..., :3]
    assert (np.linalg.norm(away[-1] - away[0], axis=-1) > 1).all()


def row(robot: Robot, backend: Kinematics, chunk: Chunk, trajectory: str = "smooth") -> dict[str, object]:
    made = _case(robot, {"compiled": backend}, [chunk], 0.0)[0]
    return {"robot": "r", "trajectory": trajectory, "joints": 6, **made}


def test_speed_counts_from_the_seed_and_what_is_beyond_a_limit_is_counted() -> None:
    chunk = chunks()["smooth"][0]
    q = np.tile(chunk.seed, (ROWS, 1))
    q[:, DIMS[0]] += 0.5 * ROBOT.velocity[DIMS[0]] * chunk.dt
    q[3:5, DIMS[2]] = ROBOT.upper[DIMS[2]] + 1e-6
    made = row(ROBOT, guess(q, 0.0), chunk)
    assert made["violations"] == 2
    q[3:5, DIMS[2]] = chunk.seed[DIMS[2]]
    made = row(ROBOT, guess(q, 0.0), chunk)
    assert made["velocity_ratio"] == pytest.approx(0.5)
    assert made["violations"] == 0


def test_errors_are_those_of_frames_that_no_wall_holds_back_and_the_others_stand_beside_them() -> None:
    chunk = chunks()["smooth"][0]
    solved = guess(np.tile(chunk.seed, (ROWS, 1)), 1e-5)._result
    solved.flags[10:20, 0] = int(IkFlag.AT_VELOCITY)
    solved.position_error[10:20, 0] = 0.004
    solved.rotation_error[0, 1] = math.radians(0.01)
    made = row(ROBOT, Guess(solved), chunk)
    assert made["position_error_mm"] == pytest.approx(0.01)
    assert made["position_error_held_mm"] == pytest.approx(4.0)
    assert made["held_share"] == pytest.approx(0.1)
    assert made["rotation_error_deg"] == pytest.approx(0.01)


def test_bounds_are_for_the_default_backend_and_exactness_only_where_it_is_possible() -> None:
    backend = guess(np.tile(chunks()["smooth"][0].seed, (ROWS, 1)), 1e-3)
    made = row(ROBOT, backend, chunks()["smooth"][0])
    assert backend.asked >= 4
    holds = {figure.name: figure.holds for figure in _figures(made)}
    assert holds["position_error_mm.r.smooth"] is False
    assert holds["rotation_error_deg.r.smooth"] is True
    assert holds["velocity_ratio.r.smooth"] is True
    far = {f.name: f.holds for f in _figures({**made, "trajectory": OUT_OF_REACH})}
    assert far["position_error_mm.r.out_of_reach"] is None
    other = {f.name: f.holds for f in _figures({**made, "kind": "other"})}
    assert other["position_error_mm.r.smooth.other"] is None


@pytest.mark.parametrize(
    ("took", "calls", "enough"),
    [
        (1e-4, 8, False),  # a call for each of eight chunks
        (1e-4, 24, False),
        (1e-4, 6000, True),
        (0.1, 7, False),
        (0.1, 8, False),
        (0.1, 11, True),
        (2.0, 7, False),
        (2.0, 8, True),
    ],
)
def test_a_fast_backend_gets_its_time_and_a_slow_one_a_call_for_each_chunk(
    took: float, calls: int, enough: bool
) -> None:
    assert _enough([_Call(took, took)] * calls, 8, 0.5) is enough


def test_a_backend_that_had_its_time_is_not_asked_on_while_another_needs_more() -> None:
    chunk = chunks()["smooth"][0]
    q = np.tile(chunk.seed, (ROWS, 1))
    fast, slow = guess(q, 0.0), Slow(guess(q, 0.0)._result)
    _case(ROBOT, {"compiled": fast, "other": slow}, [chunk], 0.02)
    assert slow.asked < fast.asked


def test_the_ratio_is_of_processor_time() -> None:
    def of(kind: str, used: float) -> dict[str, object]:
        return {"robot": "r", "trajectory": "t", "kind": kind, "chunk_ms": 5.0, "chunk_cpu_ms": used}

    assert [
        (figure.name, figure.value) for figure in _compared([of("compiled", 0.05), of("other", 25.0)])
    ] == [("ratio.r.t.other", 500.0)]


def test_a_chunk_of_all_arms_may_take_as_long_as_its_arms_together() -> None:
    made = row(ROBOT, guess(np.tile(chunks()["smooth"][0].seed, (ROWS, 1)), 0.0), chunks()["smooth"][0])
    assert made["arm_ms"] == pytest.approx(made["chunk_ms"] / 2)
    for joints, holds in ((6, False), (7, True)):
        (figure,) = (f for f in _figures({**made, "arm_ms": 0.15, "joints": joints}) if "arm_ms" in f.name)
        assert figure.holds is holds


def test_paths_move_joints_unhurried_on_short_legs_away_from_their_limits() -> None:
    joints = path(ROBOT, 3)
    assert (joints[:, DIMS] >= ROBOT.lower[DIMS] + 0.05 - 1e-12).all()
    assert (joints[:, DIMS] <= ROBOT.upper[DIMS] - 0.05 + 1e-12).all()
    share = np.abs(np.diff(joints, axis=0))[:, DIMS] * ROBOT.control_rate / ROBOT.velocity[DIMS]
    assert 0.3 < share.max() <= 0.4 + 1e-9
    assert len(joints) > ROWS
    np.testing.assert_array_equal(joints, path(ROBOT, 3))


def test_a_path_is_solved_from_where_it_begins_and_chunks_from_the_last_command() -> None:
    class Told(Guess):
        def forward(self, q: np.ndarray) -> np.ndarray:
            return np.zeros((*q.shape[:-1], 2, 7))

        def solve(self, targets: np.ndarray, seed: np.ndarray, *_: Any, **more: Any) -> IkResult:
            seeds.append(seed)
            shape = (len(targets), 2)
            q = np.tile(seed, (len(targets), 1)) + 1
            return IkResult(q, np.full(shape, float(len(seeds))), np.zeros(shape), np.zeros(shape, np.uint8))

    seeds: list[np.ndarray] = []
    joints = np.zeros((2 * ROWS + 1, ROBOT.dim))
    told = Told(guess(joints, 0.0)._result)
    np.testing.assert_array_equal(worst(ROBOT, told, joints, ROWS), [3.0, 3.0])
    np.testing.assert_array_equal(np.stack(seeds)[:, 0], [0.0, 1.0, 2.0])
