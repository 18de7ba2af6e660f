import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.strategies.base import ArrivedChunk
from runtime.strategies.placement import place


def chunk(observed, count, waited=False):
    """Every row is the number of the step it is meant for."""
    return ArrivedChunk(1, observed, np.arange(observed, observed + count, dtype=float)[:, None], waited)


def test_stale_rows_are_dropped_and_the_rest_keeps_its_steps():
    placed = place(chunk(10, 6), 13)
    assert placed.merged.targets.tolist() == [-1, -1, -1, 13, 14, 15]
    assert placed.rows[:, 0].tolist() == [13, 14, 15]
    assert (placed.merged.delay, placed.merged.mistimed, placed.merged.dropped) == (3, 0, "")


def test_k_max_shifts_the_chunk_and_says_by_how_much():
    placed = place(chunk(10, 9), 15, k_max=2)
    assert placed.merged.mistimed == 3
    assert placed.rows[0, 0] == 12
    assert placed.merged.targets.tolist() == [-1, -1, 15, 16, 17, 18, 19, 20, 21]


@pytest.mark.parametrize("k_max", [None, 0, 3])
def test_a_chunk_that_lies_in_the_past_is_dropped_whatever_k_max_says(k_max):
    placed = place(chunk(0, 5), 5, k_max=k_max)
    assert "arrived 5 steps after its observation, its 5 rows are all in the past" in placed.merged.dropped
    assert (placed.merged.targets == -1).all()
    assert not len(placed.rows)


def test_the_execution_horizon_is_counted_from_the_observation():
    placed = place(chunk(0, 10), 3, horizon=5)
    assert placed.merged.targets.tolist() == [-1, -1, -1, 3, 4, -1, -1, -1, -1, -1]
    late = place(chunk(0, 10), 5, horizon=5).merged.dropped
    assert "the first 5 of its 10 rows, its execution horizon, are all in the past" in late


def test_nothing_of_a_chunk_that_waited_is_stale_and_k_max_does_not_count():
    placed = place(chunk(10, 4, waited=True), 40, horizon=3, k_max=0)
    assert placed.merged.targets.tolist() == [40, 41, 42, -1]
    assert (placed.merged.delay, placed.merged.mistimed) == (30, 0)


def test_a_chunk_that_is_early_begins_at_once_and_says_so():
    placed = place(chunk(10, 4), 9)
    assert placed.merged.targets.tolist() == [9, 10, 11, 12]
    assert (placed.merged.delay, placed.merged.mistimed) == (-1, -1)


@given(
    st.integers(1, 30),
    st.integers(-2, 40),
    st.none() | st.integers(1, 40),
    st.none() | st.integers(0, 40),
    st.booleans(),
)
def test_no_row_is_used_twice_or_out_of_order_or_beyond_the_horizon(count, delay, horizon, k_max, waited):
    placed = place(chunk(5, count, waited), 5 + delay, horizon, k_max)
    used = np.flatnonzero(placed.merged.targets >= 0)
    assert len(placed.rows) == len(used) == max(0, len(used))
    assert (len(used) == 0) == bool(placed.merged.dropped)
    if len(used):
        assert (np.diff(used) == 1).all()
        assert used[-1] == min(count, horizon or count) - 1
        assert placed.merged.targets[used].tolist() == list(range(placed.first, placed.first + len(used)))
        assert placed.rows[:, 0].tolist() == (5 + used).tolist()
        late = placed.merged.targets[used[0]] - placed.rows[0, 0]
        assert late == (delay if waited else placed.merged.mistimed)
