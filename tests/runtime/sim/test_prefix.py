from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from runtime.sim.prefix import continued

NUMBERS = st.floats(-3, 3, width=32)


@given(
    arrays(np.float32, (12, 2), elements=NUMBERS),
    arrays(np.float32, (12, 2), elements=NUMBERS),
    st.integers(1, 11),
)
def test_the_prefix_comes_first_and_nothing_jumps_after_it(
    rows: np.ndarray, before: np.ndarray, kept: int
) -> None:
    answer = continued(rows, before[:kept], 0.1)
    assert answer.shape == rows.shape
    np.testing.assert_array_equal(answer[:kept], before[:kept])
    away = np.abs(answer[kept:] - answer[kept - 1])
    assert (away <= 0.1 * np.arange(1, 13 - kept)[:, None] + 1e-5).all()
    reached = np.abs(rows[kept:] - answer[kept - 1]) <= 0.1 * np.arange(1, 13 - kept)[:, None] - 1e-5
    np.testing.assert_allclose(answer[kept:][reached], rows[kept:][reached], atol=1e-5)


def test_without_a_prefix_the_rows_are_the_policys_own() -> None:
    rows = np.arange(12, dtype=np.float32).reshape(6, 2)
    assert continued(rows, rows[:0], 0.1) is rows


def test_a_prefix_as_long_as_the_chunk_is_all_of_it() -> None:
    rows, before = np.zeros((4, 2), np.float32), np.ones((6, 2), np.float32)
    np.testing.assert_array_equal(continued(rows, before, 0.1), before[:4])
