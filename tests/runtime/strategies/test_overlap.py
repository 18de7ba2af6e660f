import numpy as np
import pytest

from runtime.motion.timeline import DimensionKinds, Timeline
from runtime.strategies import overlap
from runtime.strategies.base import ArrivedChunk


def merger(**parameters):
    return overlap.merge(overlap.Config(**parameters), DimensionKinds())


def after_two(old=0.0, new=1.0, **parameters):
    """A plan of 50 rows `old`, into which one of 50 rows `new` comes at step 4."""
    timeline, merge = Timeline(1), merger(**parameters)
    merge(timeline, ArrivedChunk(1, 0, np.full((50, 1), old)), 0)
    return timeline, merge(timeline, ArrivedChunk(2, 4, np.full((50, 1), new)), 4)


def test_each_step_names_the_chunks_it_was_made_from():
    timeline, merged = after_two(blend_window=3)
    assert [timeline.at(step).contributions for step in (4, 5, 6, 7)] == [
        ((1, 1.0),),
        ((1, 0.5), (2, 0.5)),
        ((2, 1.0),),
        ((2, 1.0),),
    ]
    assert merged.overlap == 1


def test_the_window_all_is_the_whole_overlap():
    timeline, merged = after_two(blend_window="all")
    assert merged.overlap == 44
    assert timeline.at(48).action[0] == pytest.approx(44 / 45)
    assert timeline.at(49).action[0] == 1


def test_a_change_of_mind_is_followed_within_the_window():
    timeline, _ = after_two()
    assert timeline.at(4).action[0] == 0
    assert timeline.at(4 + 8 - 1).action[0] == 1


@pytest.mark.parametrize(("shape", "halfway"), [("linear", 0.5), ("cosine", 0.5), ("exponential", 0.811)])
def test_the_shape_says_how_the_old_plan_gives_way(shape, halfway):
    timeline, _ = after_two(blend_window=9, blend_shape=shape)
    assert timeline.at(8).action[0] == pytest.approx(halfway, abs=1e-3)


def test_a_chunk_that_waited_begins_at_the_first_free_step():
    timeline = Timeline(1)
    merger()(timeline, ArrivedChunk(1, 0, np.arange(9.0)[:, None], requested_while_stopped=True), 30)
    assert timeline.at(30).action[0] == 0
