from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.commitment import Commitment
from runtime.messages import ChunkMerged
from runtime.types import ActionChunk, Conditioning

RATE = 30.0


def rows(count: int, width: int = 2, first: float = 0.0) -> np.ndarray:
    """Rows that say which they are."""
    return np.repeat(first + np.arange(count, dtype=np.float32)[:, None], width, axis=1)


def merged(
    number: int, observation_step: int, delay: int, count: int = 50, mistimed: int = 0, dropped: str = ""
) -> ChunkMerged:
    targets = observation_step + mistimed + np.arange(count)
    return ChunkMerged(number, 1, observation_step + delay, delay, targets, mistimed, dropped)


def committed(
    chunk: ActionChunk | None = None, step: int = 100, delay: int = 3, waited: bool = False, mistimed: int = 0
) -> Commitment:
    """A commitment to one chunk that answers the observation of `step`."""
    made = Commitment(RATE)
    made.answered(1, chunk or ActionChunk(rows(50)), step, waited)
    made.merged(merged(1, step, delay, mistimed=mistimed))
    return made


def asked(
    held: Commitment, step: int, delays: list[int] | None = None, horizon: int | None = None
) -> Conditioning:
    found = held.conditioning(step, [3] if delays is None else delays, 0.9, horizon)
    assert found is not None
    return found


# What is left


def test_nobody_is_committed_to_anything_before_a_chunk_was_merged() -> None:
    held = Commitment(RATE)
    assert held.conditioning(100, [3], 0.9, None) is None
    held.answered(1, ActionChunk(rows(50)), 100)
    assert held.conditioning(104, [3], 0.9, None) is None


@given(st.integers(0, 40), st.integers(0, 40), st.integers(1, 30))
def test_what_is_left_begins_with_the_row_for_the_observation_whatever_the_delay(
    delay: int, later: int, count: int
) -> None:
    """The bad design shifts by a constant, or counts from the arrival."""
    held = committed(ActionChunk(rows(count)), delay=delay)
    found = held.conditioning(100 + later, [delay], 0.9, None)
    if later >= count:
        assert found is None
    else:
        assert found is not None
        assert found.consumed == later
        np.testing.assert_array_equal(found.left_over, rows(count)[later:])


def test_a_chunk_that_was_shifted_counts_from_where_it_was_put() -> None:
    assert asked(committed(delay=9, mistimed=4), 110).left_over[0, 0] == 6


def test_a_chunk_that_the_robot_waited_for_counts_from_its_arrival() -> None:
    held = committed(delay=60, waited=True)
    assert asked(held, 170).left_over[0, 0] == 10


@given(st.integers(0, 5))
def test_before_its_first_row_the_robot_stands_where_that_row_begins(early: int) -> None:
    found = asked(committed(delay=6, waited=True), 106 - early)
    assert found.left_over[:, 0].tolist() == [0.0] * early + list(range(50 - early))


def test_the_newest_merged_chunk_counts_and_what_was_dropped_does_not() -> None:
    held = committed()
    held.answered(2, ActionChunk(rows(50, first=200)), 110)
    held.answered(3, ActionChunk(rows(50, first=300)), 120)
    held.merged(merged(2, 110, 3))
    held.merged(merged(3, 120, 60, dropped="60 rows are stale"))
    assert asked(held, 125).left_over[0, 0] == 215


def test_rows_of_the_models_own_space_go_before_actions() -> None:
    chunk = ActionChunk(rows(50), model_actions=rows(50, 32, first=0.5))
    found = asked(committed(chunk), 110)
    assert found.previous.shape == (50, 32)
    assert found.left_over[0, 0] == 10.5


def test_rows_without_an_action_do_not_count_as_left() -> None:
    held = committed(ActionChunk(rows(10), model_actions=rows(50, 32)))
    assert asked(held, 109).consumed == 9
    assert held.conditioning(110, [3], 0.9, None) is None


def test_rows_relative_to_an_observation_that_is_over_are_not_handed_back() -> None:
    held = committed(ActionChunk(rows(50), mode="relative"))
    assert held.conditioning(110, [3], 0.9, None) is None
    assert "relative to an observation that is over" in held.warning
    assert asked(committed(ActionChunk(rows(50), mode="delta")), 110).consumed == 10
    own = ActionChunk(rows(50), mode="relative", model_actions=rows(50, 32))
    assert asked(committed(own), 110).consumed == 10


# Rates


@given(st.floats(3, 120), st.integers(0, 60), st.integers(0, 40))
def test_at_another_rate_the_row_nearest_to_the_observation_is_the_first(
    rate: float, later: int, delay: int
) -> None:
    held = committed(ActionChunk(rows(400), rate=rate))
    found = held.conditioning(100 + later, [delay], 0.9, None)
    assert found is not None
    apart = found.consumed / rate - later / RATE
    assert abs(apart) <= 0.5 / rate + 1e-6
    assert -1e-6 <= found.predicted_delay - delay * rate / RATE < 1 + 1e-6


# The predicted delay


def test_a_high_quantile_of_the_measured_delays_is_predicted() -> None:
    delays = [3] * 18 + [4, 9]
    assert asked(committed(), 110, delays).predicted_delay == 4
    held = committed()
    found = held.conditioning(110, delays, 1.0, None)
    assert found is not None
    assert found.predicted_delay == held.predicted_delay == 9


def test_the_chunks_own_delay_is_predicted_where_no_other_was_measured() -> None:
    assert asked(committed(delay=7), 110, []).predicted_delay == 7


@given(st.integers(0, 60), st.integers(0, 49), st.one_of(st.none(), st.integers(1, 80)))
def test_it_warns_exactly_where_the_answer_comes_after_the_last_row_that_may_be_executed(
    delay: int, later: int, horizon: int | None
) -> None:
    held = committed()
    found = held.conditioning(100 + later, [delay], 0.9, horizon)
    last = 50 if horizon is None else min(50, horizon)
    assert (found is None) == (later >= last)
    if found is not None:
        assert found.execution_horizon == last
        assert bool(held.warning) == (delay > last - later)


def test_the_warning_says_the_numbers() -> None:
    held = committed()
    asked(held, 110, [12], 20)
    assert "expected after 12 rows, but 10 of the 20 that may be executed are left" in held.warning
    asked(held, 105, [12], 20)
    assert held.warning == ""


# Resets


def test_a_reset_forgets_what_was_merged_and_what_was_on_its_way() -> None:
    held = committed()
    held.answered(2, ActionChunk(rows(50)), 110)
    held.clear()
    held.merged(merged(2, 110, 3))
    assert held.conditioning(115, [3], 0.9, None) is None


def test_a_reply_that_was_in_flight_at_a_reset_never_counts() -> None:
    held = committed()
    sent_in = held.generation
    held.clear()
    held.answered(2, ActionChunk(rows(50)), 110, generation=sent_in)
    held.merged(merged(2, 110, 3))
    assert held.conditioning(115, [3], 0.9, None) is None
    held.answered(3, ActionChunk(rows(50)), 120, generation=held.generation)
    held.merged(merged(3, 120, 3))
    assert asked(held, 125).consumed == 5


events = st.lists(
    st.tuples(st.sampled_from(["ask", "answer", "merge", "drop", "clear"]), st.integers(0, 3)), max_size=30
)


@given(events)
def test_only_an_answer_asked_for_and_merged_since_the_last_reset_counts(
    given_: list[tuple[str, int]],
) -> None:
    held = Commitment(RATE)
    expected: int | None = None
    asked_in: dict[int, int] = {}
    answered_in: dict[int, int] = {}
    cleared = 0
    for what, number in given_:
        if what == "ask":
            asked_in[number] = cleared
        elif what == "answer" and number in asked_in:
            chunk = ActionChunk(rows(50, first=1000.0 * number))
            held.answered(number, chunk, 100, generation=asked_in[number])
            if asked_in.pop(number) == cleared:
                answered_in[number] = cleared
        elif what in ("merge", "drop"):
            held.merged(merged(number, 100, 3, dropped="late" if what == "drop" else ""))
            fresh = answered_in.pop(number, None) == cleared
            if what == "merge" and fresh and (expected is None or number >= expected):
                expected = number
        elif what == "clear":
            held.clear()
            cleared += 1
            expected = None
            answered_in.clear()
    found = held.conditioning(105, [3], 0.9, None)
    assert (found is None) == (expected is None)
    if found is not None and expected is not None:
        assert found.left_over[0, 0] == pytest.approx(1000.0 * expected + 5)
