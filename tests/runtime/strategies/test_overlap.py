import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.strategies import overlap
from runtime.strategies.base import Arrival, Progress
from runtime.timeline import Timeline


def policy(step, horizon):
    """What an ideal policy means for the steps from `step` on: the step's own number."""
    return np.arange(step, step + horizon, dtype=float)[:, None]


@given(st.lists(st.tuples(st.integers(0, 7), st.integers(0, 9)), max_size=20), st.integers(8, 30))
def test_the_published_action_for_a_step_is_the_one_meant_for_it_whatever_the_delays(requests, horizon):
    merge = overlap.merge(overlap.Config(blend_window="all"), ())
    timeline, step = Timeline(1), 0
    for number, (delay, gap) in enumerate(requests):
        observed = step
        step = observed + delay
        merged = merge(timeline, Arrival(number, observed, policy(observed, horizon)), step)
        assert merged.delay == delay
        assert merged.mistimed == 0
        for _ in range(gap):
            planned = timeline.at(step)
            assert planned is None or planned.action[0] == pytest.approx(step, abs=1e-9)
            step += 1


def test_stale_rows_are_dropped_and_the_rest_keeps_its_steps():
    timeline = Timeline(1)
    merged = overlap.merge(overlap.Config(), ())(timeline, Arrival(1, 10, policy(10, 6)), 13)
    assert merged.targets.tolist() == [-1, -1, -1, 13, 14, 15]
    assert timeline.at(13).action[0] == 13
    assert timeline.at(16) is None


def test_k_max_shifts_the_chunk_and_says_by_how_much():
    timeline = Timeline(1)
    merged = overlap.merge(overlap.Config(k_max=2), ())(timeline, Arrival(1, 10, policy(10, 9)), 15)
    assert merged.mistimed == 3
    assert timeline.at(15).action[0] == 12


def test_a_chunk_that_lies_in_the_past_is_dropped_even_with_k_max_and_the_plan_stays():
    timeline = Timeline(1)
    merge = overlap.merge(overlap.Config(k_max=0), ())
    merge(timeline, Arrival(1, 0, policy(0, 20)), 0)
    merged = merge(timeline, Arrival(2, 0, policy(0, 5)), 5)
    assert "all in the past" in merged.dropped
    assert (merged.targets == -1).all()
    assert timeline.at(6).makers == ((1, 1.0),)


def test_each_step_names_the_chunks_it_was_made_from():
    timeline = Timeline(1)
    merge = overlap.merge(overlap.Config(blend_window=3), ())
    merge(timeline, Arrival(1, 0, np.zeros((10, 1))), 0)
    merge(timeline, Arrival(2, 4, np.ones((10, 1))), 4)
    assert [timeline.at(step).makers for step in (4, 5, 6, 7)] == [
        ((1, 1.0),),
        ((1, 0.5), (2, 0.5)),
        ((2, 1.0),),
        ((2, 1.0),),
    ]


def test_a_change_of_mind_is_followed_within_the_window():
    timeline = Timeline(1)
    merge = overlap.merge(overlap.Config(blend_window=8), ())
    merge(timeline, Arrival(1, 0, np.zeros((50, 1))), 0)
    merge(timeline, Arrival(2, 0, np.ones((50, 1))), 3)
    assert timeline.at(10).action[0] == 1


def test_the_query_asks_back_to_back_but_never_twice_at_once():
    query = overlap.query(overlap.Config())
    assert query.wants(Progress(remaining=40, in_flight=False, since_request=0.0))
    assert not query.wants(Progress(remaining=0, in_flight=True, since_request=9.0))


def test_the_query_keeps_its_rate():
    query = overlap.query(overlap.Config(inference_rate=5.0))
    assert query.wants(Progress(remaining=40, in_flight=False, since_request=float("inf")))
    assert not query.wants(Progress(remaining=40, in_flight=False, since_request=0.19))
    assert query.wants(Progress(remaining=40, in_flight=False, since_request=0.2))
