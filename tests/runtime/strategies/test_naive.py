import numpy as np

from runtime.motion.timeline import DimensionKinds, Timeline
from runtime.strategies import naive
from runtime.strategies.base import ArrivedChunk


def test_the_newest_chunk_replaces_the_rest_of_the_old_one():
    timeline, merge = Timeline(1), naive.merge(naive.Config(), DimensionKinds())
    merge(timeline, ArrivedChunk(1, 0, np.zeros((50, 1))), 0)
    merged = merge(timeline, ArrivedChunk(2, 1, np.ones((20, 1))), 4)
    assert (timeline.executed_rows(4)[0] == 1).all()
    assert timeline.remaining(4) == 17
    assert timeline.at(4).contributions == ((2, 1.0),)
    assert merged.overlap == 0


def test_a_chunk_that_comes_so_late_that_it_is_shifted_is_faded_over_to():
    timeline, merge = Timeline(1), naive.merge(naive.Config(k_max=2), DimensionKinds())
    merge(timeline, ArrivedChunk(1, 0, np.zeros((400, 1))), 0)
    merged = merge(timeline, ArrivedChunk(2, 0, np.full((400, 1), 0.5)), 300)
    assert merged.mistimed == 298
    planned = timeline.executed_rows(300)[0][:, 0]
    assert np.diff(planned, prepend=0.0).max() < 0.1
    assert planned[-1] == 0.5
