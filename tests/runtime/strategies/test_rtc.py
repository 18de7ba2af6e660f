import numpy as np

from runtime.motion.timeline import DimensionKinds, Timeline
from runtime.strategies import rtc
from runtime.strategies.base import ArrivedChunk, join


def test_its_requests_carry_what_the_robot_is_committed_to():
    assert rtc.query(rtc.Config()).uses_rtc
    assert not rtc.query(rtc.Config()).requests_while_stopped


def test_what_is_left_of_a_seam_passes_the_overlap_blend():
    timeline, merge = Timeline(1), rtc.merge(rtc.Config(blend_window=5), DimensionKinds())
    merge(timeline, ArrivedChunk(1, 0, np.zeros((50, 1))), 0)
    merge(timeline, ArrivedChunk(2, 1, np.ones((50, 1))), 4)
    assert timeline.executed_rows(4)[0][:6, 0].tolist() == [0, 0.25, 0.5, 0.75, 1, 1]


def test_a_chunk_that_passes_through_what_was_executed_last_is_laid_as_it_is():
    """A server that keeps the contract has gone over to its own rows by itself."""
    timeline, merge = Timeline(2), rtc.merge(rtc.Config(blend_window=5), DimensionKinds(switched=(1,)))
    merge(timeline, ArrivedChunk(1, 0, np.zeros((50, 2))), 0)
    answer = np.ones((50, 2))
    answer[:4] = [2e-4, 1.0]  # the gripper switches when it likes
    merged = merge(timeline, ArrivedChunk(2, 1, answer), 5)
    assert timeline.executed_rows(5)[0][:3].tolist() == [[1.0, 1.0]] * 3
    assert (merged.overlap, len(merged.contributions)) == (0, 0)


def test_it_continues_on_the_circle_and_ends_the_fade_that_it_continues():
    timeline, merge = Timeline(1), rtc.merge(rtc.Config(), DimensionKinds(wrapping=(0,)))
    join(
        merge,
        timeline,
        ArrivedChunk(1, 0, np.full((50, 1), 3.0)),
        0,
        np.array([2.0]),
        DimensionKinds(wrapping=(0,)),
    )
    executed = timeline.executed_rows(0)[0]
    answer = np.concatenate([executed[1:4], np.full((40, 1), 2.5)]) - 2.0 * np.pi
    join(merge, timeline, ArrivedChunk(2, 1, answer), 4, None, DimensionKinds(wrapping=(0,)))
    np.testing.assert_allclose(timeline.executed_rows(4)[0], 2.5)


def test_it_tells_of_each_step_that_is_not_the_chunks_alone_who_makes_it():
    timeline, merge = Timeline(1), rtc.merge(rtc.Config(blend_window=3), DimensionKinds())
    merge(timeline, ArrivedChunk(1, 0, np.zeros((50, 1))), 0)
    merged = merge(timeline, ArrivedChunk(2, 1, np.ones((50, 1))), 4)
    assert merged.contributions.tolist() == [[4, 1, 1.0], [5, 1, 0.5], [5, 2, 0.5]]


def test_where_too_many_have_a_part_in_the_steps_nothing_is_told():
    timeline, merge = Timeline(1), rtc.merge(rtc.Config(blend_window="all"), DimensionKinds())
    merge(timeline, ArrivedChunk(1, 0, np.zeros((2000, 1))), 0)
    merge(timeline, ArrivedChunk(2, 1, np.ones((2000, 1))), 4)
    merged = merge(timeline, ArrivedChunk(3, 5, np.full((2000, 1), 2.0)), 9)
    assert merged.overlap > 1000
    assert merged.contributions is None
