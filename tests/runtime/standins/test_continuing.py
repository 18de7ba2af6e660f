from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from robots import load_robot
from runtime.core.types import Float32
from runtime.standins.continuing import CommittedPrefix, ModelSpace, continue_prefix

ROBOT = load_robot("agilex_piper")
ROWS = arrays(np.float32, (12, 2), elements=st.floats(-3, 3, width=32))


@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 50), st.integers(0, 50))
def test_the_first_rows_are_the_prefix_and_the_last_are_the_plans_own(
    count: int, left: int, delay: int, end: int
) -> None:
    plan, before = np.ones((count, 2), np.float32), np.zeros((left, 2))
    made = continue_prefix(plan, CommittedPrefix(before, delay, end), switched=[1])
    kept = min(delay, left, count)
    assert made.shape == plan.shape
    np.testing.assert_array_equal(made[:kept], 0.0)
    np.testing.assert_array_equal(made[kept:, 1], 1.0)
    assert np.all(np.diff(made[:, 0]) >= 0)
    np.testing.assert_array_equal(made[max(kept, min(end, kept + 8, left, count)) :], 1.0)


def test_the_plan_takes_over_bit_by_bit() -> None:
    made = continue_prefix(np.ones((6, 1), np.float32), CommittedPrefix(np.zeros((6, 1)), 2, 5))
    np.testing.assert_allclose(made[:, 0], [0, 0, 0.25, 0.5, 0.75, 1])


@given(ROWS, ROWS, st.integers(0, 12), st.integers(0, 12))
def test_every_row_is_the_prefixs_or_the_plans_or_between_the_two(
    plan: Float32, before: Float32, delay: int, end: int
) -> None:
    made = continue_prefix(plan, CommittedPrefix(before.astype(np.float64), delay, end))
    assert np.all(made >= np.minimum(plan, before))
    assert np.all(made <= np.maximum(plan, before))
    np.testing.assert_array_equal(made[:delay], before[:delay])


def test_without_a_prefix_the_rows_are_the_plans_own() -> None:
    plan = np.arange(12, dtype=np.float32).reshape(6, 2)
    np.testing.assert_array_equal(continue_prefix(plan, CommittedPrefix(np.zeros((0, 2)), 0, 0)), plan)


def test_a_prefix_as_long_as_the_chunk_is_all_of_it() -> None:
    made = continue_prefix(np.zeros((4, 2), np.float32), CommittedPrefix(np.ones((6, 2)), 6, 6))
    np.testing.assert_array_equal(made, np.ones((4, 2)))


@given(st.lists(st.floats(-3, 3), min_size=14, max_size=14))
def test_joints_survive_the_way_over_the_models_own_space(values: list[float]) -> None:
    space = ModelSpace(ROBOT)
    rows = np.array([values], np.float32)
    model = space.encode(rows)
    assert model.shape == (1, 32)
    np.testing.assert_allclose(space.joints(model), rows, atol=1e-5)
    np.testing.assert_array_equal(space.joints(rows), rows)


def test_a_joint_without_end_has_a_place_in_the_models_space_too() -> None:
    endless = replace(ROBOT, lower=np.full(14, -np.inf), upper=np.full(14, np.inf))
    space = ModelSpace(endless)
    np.testing.assert_allclose(space.encode(np.full((1, 14), np.pi, np.float32))[0, :14], 1.0, rtol=1e-6)


@pytest.mark.parametrize("shape", [(3, 13), (32,), (0, 14)])
def test_a_chunk_of_no_known_shape_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"expected \[T, 14\] or \[T, 32\]"):
        ModelSpace(ROBOT).joints(np.zeros(shape))
