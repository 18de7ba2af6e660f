import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.motion.timeline import DimensionKinds, Timeline
from runtime.strategies import ensemble
from runtime.strategies.base import ArrivedChunk, join


def merger(dims=None, **parameters):
    return ensemble.merge(ensemble.Config(**parameters), dims or DimensionKinds())


def rows(value, count=50, dim=1):
    return np.full((count, dim), float(value))


def test_every_chunk_that_covers_a_step_has_its_say_the_oldest_the_greatest():
    timeline, merge = Timeline(1), merger(ensemble_m=0.5)
    for number in range(3):
        merge(timeline, ArrivedChunk(number + 1, number, rows(number)), number)
    weights = np.exp(-0.5 * np.arange(3))
    weights /= weights.sum()
    assert dict(timeline.at(2).contributions) == pytest.approx(dict(zip((1, 2, 3), weights, strict=True)))
    assert timeline.at(2).action[0] == pytest.approx(weights @ [0, 1, 2])


def test_a_step_is_made_by_those_alone_that_cover_it():
    timeline, merge = Timeline(1), merger()
    merge(timeline, ArrivedChunk(1, 0, rows(0, 10)), 0)
    merged = merge(timeline, ArrivedChunk(2, 4, rows(1, 10)), 6)
    assert [len(timeline.at(step).contributions) for step in range(6, 14)] == [2, 2, 2, 2, 1, 1, 1, 1]
    assert timeline.at(10).action[0] == 1
    assert merged.overlap == 4


def test_a_chunk_is_placed_by_its_observation_and_not_by_its_arrival():
    timeline, merge = Timeline(1), merger()
    for observed in (0, 5, 10):
        merge(
            timeline,
            ArrivedChunk(observed + 1, observed, np.arange(observed, observed + 30.0)[:, None]),
            observed + 4,
        )
    assert [timeline.at(step).action[0] for step in (14, 20, 39)] == [14, 20, 39]


def test_at_most_so_many_chunks_make_a_step_and_no_more_are_kept():
    timeline, merge = Timeline(1), merger(ensemble_horizon=3)
    for step in range(20):
        merge(timeline, ArrivedChunk(step + 1, step, rows(step)), step)
    assert [maker for maker, _ in timeline.at(19).contributions] == [18, 19, 20]
    assert len(timeline.laid) == 3


def test_the_chunk_is_used_whole_whatever_the_execution_horizon():
    timeline = Timeline(1)
    merged = merger(execution_horizon=5)(timeline, ArrivedChunk(1, 0, rows(0)), 2)
    assert timeline.remaining(2) == 48
    assert (merged.targets >= 0).sum() == 48


def test_a_gripper_is_where_the_newest_chunk_says():
    timeline, merge = Timeline(2), merger(DimensionKinds(switched=(1,)))
    merge(timeline, ArrivedChunk(1, 0, rows(0, dim=2)), 0)
    merge(timeline, ArrivedChunk(2, 1, rows(1, dim=2)), 1)
    assert 0 < timeline.at(1).action[0] < 1
    assert timeline.at(1).action[1] == 1


def test_angles_that_wrap_average_on_the_circle():
    dims = DimensionKinds(wrapping=(0,))
    timeline, merge = Timeline(1), merger(dims, ensemble_m=0.0)
    join(merge, timeline, ArrivedChunk(1, 0, rows(3.0)), 0, None, dims)
    join(merge, timeline, ArrivedChunk(2, 1, rows(-3.0)), 1, None, dims)
    assert timeline.at(1).action[0] == pytest.approx(np.pi)


@given(st.lists(st.tuples(st.integers(0, 12), st.integers(0, 6)), min_size=1, max_size=15), st.integers(1, 5))
def test_equal_chunks_average_to_themselves_exactly_and_the_past_is_forgotten(requests, horizon):
    timeline, merge = Timeline(1), merger(ensemble_horizon=horizon, ensemble_m=0.3)
    meant = np.sin(np.arange(400.0))[:, None]
    observed = 0
    for number, (delay, gap) in enumerate(requests, 1):
        free = observed + delay
        merge(timeline, ArrivedChunk(number, observed, meant[observed : observed + 13]), free)
        assert (timeline.rows == meant[free : observed + 13]).all()
        assert len(timeline.laid) <= horizon
        assert all(chunk.first == free and len(chunk.rows) <= 13 for chunk in timeline.laid)
        observed = free + gap
