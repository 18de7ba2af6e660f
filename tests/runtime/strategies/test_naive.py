import numpy as np

from runtime.motion.timeline import DimensionKinds, Timeline
from runtime.strategies import naive
from runtime.strategies.base import Arrival


def test_the_newest_chunk_replaces_the_rest_of_the_old_one():
    timeline, merge = Timeline(1), naive.merge(naive.Config(), DimensionKinds())
    merge(timeline, Arrival(1, 0, np.zeros((50, 1))), 0)
    merged = merge(timeline, Arrival(2, 1, np.ones((20, 1))), 4)
    assert (timeline.span(4)[0] == 1).all()
    assert timeline.remaining(4) == 17
    assert timeline.at(4).makers == ((2, 1.0),)
    assert merged.overlap == 0
