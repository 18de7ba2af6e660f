import numpy as np
import pytest

from runtime.core.plugins import variants
from runtime.motion.timeline import HELD, DimensionKinds, Timeline, single_contribution
from runtime.strategies import naive, overlap, sync
from runtime.strategies.base import JOIN_WINDOW, ArrivedChunk, Paced, Progress, StrategyParameters, join

PLAIN = DimensionKinds()
STRATEGIES = variants("runtime.strategies")


def rows(value, count, dim=1):
    return np.full((count, dim), float(value))


def merger(module, dims=PLAIN, **parameters):
    return module.merge(module.Config(**parameters), dims)


def planned(value, count, first=0):
    timeline = Timeline(1)
    timeline.replace(first, rows(value, count), single_contribution(7, count))
    return timeline


def test_the_five_strategies_are_found_by_their_kind():
    assert set(STRATEGIES) == {"sync", "async", "ensemble", "naive", "rtc"}


@pytest.mark.parametrize("kind", sorted(STRATEGIES))
def test_what_a_strategy_uses_is_among_the_parameters_of_all(kind):
    assert STRATEGIES[kind].USES
    assert set(STRATEGIES[kind].USES) <= set(StrategyParameters.model_fields)


def test_which_strategies_wait_and_which_tell_what_the_robot_is_committed_to():
    queries = {kind: module.query(module.Config()) for kind, module in STRATEGIES.items()}
    assert {kind for kind, query in queries.items() if query.requests_while_stopped} == {"sync"}
    assert {kind for kind, query in queries.items() if query.uses_rtc} == {"rtc"}
    assert {kind for kind, module in STRATEGIES.items() if merger(module).requests_while_stopped} == {"sync"}


def test_back_to_back_asks_at_once_but_never_twice():
    query = Paced(None)
    assert query.should_request(Progress(remaining=40, in_flight=False, since_request=0.0))
    assert not query.should_request(Progress(remaining=0, in_flight=True, since_request=9.0))


def test_a_rate_is_kept():
    query = Paced(5.0)
    assert query.should_request(Progress(remaining=40, in_flight=False, since_request=float("inf")))
    assert not query.should_request(Progress(remaining=40, in_flight=False, since_request=0.19))
    assert query.should_request(Progress(remaining=40, in_flight=False, since_request=0.2))


def test_a_chunk_after_starvation_takes_over_from_the_held_target():
    timeline = Timeline(1)
    merged = join(merger(naive), timeline, ArrivedChunk(1, 0, rows(7, 20)), 3, np.zeros(1), PLAIN)
    actions = [timeline.at(step).action[0] for step in range(3, 13)]
    assert actions == pytest.approx([0, 1, 2, 3, 4, 5, 6, 7, 7, 7])
    assert timeline.at(3).contributions == ((HELD, 1.0),)
    assert dict(timeline.at(4).contributions) == pytest.approx({HELD: 6 / 7, 1: 1 / 7})
    assert merged.overlap == JOIN_WINDOW - 2


def test_two_rows_take_over_at_the_second_so_that_starving_again_and_again_still_moves():
    timeline = Timeline(1)
    join(merger(naive), timeline, ArrivedChunk(1, 0, rows(7, 5)), 3, np.zeros(1), PLAIN)
    assert timeline.executed_rows(3)[0][:, 0].tolist() == [0, 7]


def test_a_switched_strategy_takes_over_from_the_old_plan_whatever_its_own_window():
    timeline = planned(0, 30)
    merged = join(
        merger(overlap, blend_window="all"),
        timeline,
        ArrivedChunk(8, 0, rows(7, 20)),
        3,
        None,
        PLAIN,
        joining=True,
    )
    assert [timeline.at(step).action[0] for step in range(3, 12)] == pytest.approx(
        [0, 1, 2, 3, 4, 5, 6, 7, 7]
    )
    assert dict(timeline.at(4).contributions) == pytest.approx({7: 6 / 7, 8: 1 / 7})
    assert merged.overlap == 6


def test_an_old_plan_that_ends_early_is_held_where_it_ends():
    timeline = planned(0, 5)
    join(merger(naive), timeline, ArrivedChunk(8, 0, rows(7, 20)), 3, None, PLAIN, joining=True)
    assert [timeline.at(step).action[0] for step in range(3, 12)] == pytest.approx(
        [0, 1, 2, 3, 4, 5, 6, 7, 7]
    )
    assert [timeline.at(step).contributions[0][0] for step in (4, 5)] == [7, HELD]


def test_a_switch_while_nothing_is_planned_starts_from_the_last_command():
    timeline = Timeline(1)
    arrival = ArrivedChunk(8, 0, rows(7, 20), requested_while_stopped=True)
    join(merger(sync), timeline, arrival, 3, None, PLAIN, joining=True, commanded=np.zeros(1))
    assert timeline.at(3).contributions == ((HELD, 1.0),)
    assert timeline.at(10).action[0] == 7


def test_chunks_that_come_while_a_fade_is_under_way_do_not_end_it():
    timeline = planned(0, 30)
    merge = merger(naive)
    join(merge, timeline, ArrivedChunk(8, 0, rows(7, 20)), 3, None, PLAIN, joining=True)
    join(merge, timeline, ArrivedChunk(9, 2, rows(7, 20)), 5, None, PLAIN)
    assert [timeline.at(step).action[0] for step in range(5, 11)] == pytest.approx([2, 3, 4, 5, 6, 7])
    assert dict(timeline.at(5).contributions) == pytest.approx({7: 5 / 7, 9: 2 / 7})


def test_a_second_join_starts_from_what_was_executed_and_not_from_what_was_planned_beneath():
    timeline = planned(0, 30)
    join(merger(naive), timeline, ArrivedChunk(8, 0, rows(7, 20)), 3, None, PLAIN, joining=True)
    join(merger(overlap), timeline, ArrivedChunk(9, 2, rows(-7, 20)), 5, None, PLAIN, joining=True)
    assert timeline.at(5).action[0] == pytest.approx(2)
    assert dict(timeline.at(5).contributions) == pytest.approx({7: 5 / 7, 8: 2 / 7})
    assert timeline.at(12).action[0] == -7


@pytest.mark.parametrize("how", [{"held": np.zeros(1)}, {"held": None, "joining": True}])
def test_a_dropped_chunk_changes_nothing(how):
    timeline = planned(3, 30)
    merged = join(merger(overlap), timeline, ArrivedChunk(8, 0, rows(7, 4)), 9, dims=PLAIN, **how)
    assert merged.dropped
    assert timeline.fade is None
    assert (timeline.first, timeline.remaining(0)) == (0, 30)


def test_a_gripper_switches_also_where_a_chunk_joins():
    dims = DimensionKinds(switched=(1,))
    timeline = Timeline(2)
    join(merger(naive, dims), timeline, ArrivedChunk(1, 0, rows(1, 20, 2)), 0, np.zeros(2), dims)
    assert timeline.at(0).action.tolist() == [0.0, 1.0]


def test_an_angle_that_wraps_stays_on_the_branch_of_the_last_command():
    dims = DimensionKinds(wrapping=(0,))
    timeline = Timeline(1)
    before = np.array([7.0])
    join(
        merger(naive, dims),
        timeline,
        ArrivedChunk(1, 0, rows(7 - 2 * np.pi, 20)),
        0,
        None,
        dims,
        commanded=before,
    )
    assert timeline.at(0).action[0] == pytest.approx(7.0)


def test_an_angle_that_wraps_joins_the_plan_the_shorter_way_round():
    dims = DimensionKinds(wrapping=(0,))
    timeline = planned(3.0, 30)
    join(merger(overlap, dims), timeline, ArrivedChunk(1, 0, rows(-3.0, 20)), 0, None, dims)
    actions = timeline.executed_rows(0)[0][:, 0]
    assert actions[0] == pytest.approx(3.0)
    assert actions[-1] == pytest.approx(2 * np.pi - 3.0)
    assert np.abs(np.diff(actions)).max() < 0.05
