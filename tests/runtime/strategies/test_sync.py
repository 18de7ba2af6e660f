import numpy as np

from runtime.motion.timeline import DimensionKinds, Timeline, single_contribution
from runtime.strategies import sync
from runtime.strategies.base import ArrivedChunk, Progress


def merger(**parameters):
    return sync.merge(sync.Config(**parameters), DimensionKinds())


def test_every_action_is_executed_in_order_whatever_the_delay():
    timeline = Timeline(1)
    merged = merger()(
        timeline, ArrivedChunk(1, 10, np.arange(5.0)[:, None], requested_while_stopped=True), 40
    )
    assert [timeline.at(40 + i).action[0] for i in range(5)] == [0, 1, 2, 3, 4]
    assert merged.delay == 30
    assert merged.mistimed == 0
    assert merged.dropped == ""


def test_the_execution_horizon_crops_the_chunk():
    timeline = Timeline(1)
    merged = merger(execution_horizon=2)(
        timeline, ArrivedChunk(1, 0, np.ones((5, 1)), requested_while_stopped=True), 3
    )
    assert timeline.remaining(3) == 2
    assert merged.targets.tolist() == [3, 4, -1, -1, -1]


def test_what_is_planned_is_finished_before_a_chunk_that_was_asked_while_moving():
    timeline = Timeline(1)
    timeline.replace(0, np.zeros((10, 1)), single_contribution(1, 10))
    merged = merger()(timeline, ArrivedChunk(2, 0, np.ones((20, 1))), 3)
    assert "the 7 steps still planned are finished first" in merged.dropped
    assert timeline.remaining(3) == 7


def test_a_chunk_that_was_asked_while_moving_is_not_taken_for_one_of_a_standing_robot():
    timeline = Timeline(1)
    merged = merger()(timeline, ArrivedChunk(2, 0, np.ones((20, 1))), 3)
    assert "the next is asked as it stands" in merged.dropped
    assert timeline.remaining(3) == 0


def test_it_asks_only_when_nothing_is_left_and_nothing_is_in_flight():
    query = sync.query(sync.Config())
    assert query.should_request(Progress(0, False, 0.0))
    assert not query.should_request(Progress(1, False, 9.0))
    assert not query.should_request(Progress(0, True, 9.0))
