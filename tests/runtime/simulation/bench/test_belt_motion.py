from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.simulation.bench.belt_motion import ACCELERATION, SPEED, draw_belt_motion
from runtime.simulation.bench.bench import Belt, BenchError

BELT = Belt()
DT = 1e-3


def sampled(seed: int, seconds: float = 20.0) -> np.ndarray:
    course = draw_belt_motion(seed, BELT, seconds)
    return np.array([course.x(t) for t in np.arange(0.0, course.duration, DT)])


@given(st.integers(0, 10**9), st.floats(0.5, 30.0))
def test_a_block_never_leaves_the_belt(seed: int, seconds: float) -> None:
    knots = draw_belt_motion(seed, BELT, seconds).knots
    low, high = BELT.x
    turning = knots[:, 1] + knots[:, 2] * np.abs(knots[:, 2]) / (2 * ACCELERATION)  # as far as it goes on
    assert (knots[:, 1] >= low).all()
    assert (knots[:, 1] <= high).all()
    assert (turning >= low).all()
    assert (turning <= high).all()


def test_it_goes_on_without_a_jump_within_its_speeds_and_its_acceleration() -> None:
    speed = np.diff(sampled(3)) / DT
    assert np.abs(speed).max() <= SPEED[1] + 1e-9
    assert np.abs(np.diff(speed)).max() <= ACCELERATION * DT + 1e-9
    cruising = np.abs(speed[1:][np.abs(np.diff(speed)) < 1e-9])
    assert (cruising[cruising > 1e-6] >= SPEED[0] - 1e-9).all()


def test_the_same_seed_gives_the_same_course_and_another_one_another() -> None:
    np.testing.assert_array_equal(sampled(5), sampled(5))
    assert np.abs(sampled(5)[:1000] - sampled(6)[:1000]).max() > 1e-3


def test_when_it_changes_cannot_be_told_from_the_time() -> None:
    changes = [draw_belt_motion(seed, BELT, 20.0).changes for seed in range(20)]
    assert all(len(times) >= 5 for times in changes)
    pauses = np.concatenate([np.diff(times[:-1]) for times in changes])
    assert pauses.std() > 0.3 * pauses.mean()


def test_it_stands_before_and_after() -> None:
    course = draw_belt_motion(1, BELT, 20.0)
    assert 20.0 <= course.duration <= 20.0 + SPEED[1] / ACCELERATION
    assert course.x(-1.0) == course.x(0.0)
    assert course.x(course.duration + 9.0) == course.x(course.duration)
    before = course.x(course.duration) - course.x(course.duration - DT)
    assert abs(before) <= ACCELERATION * DT * DT


def test_a_belt_that_is_too_short_is_refused() -> None:
    with pytest.raises(BenchError, match=r"a belt of 0\.200 m was given; allowed: 0\.233 m or more"):
        draw_belt_motion(0, Belt(x=(0.0, 0.2)), 20.0)
