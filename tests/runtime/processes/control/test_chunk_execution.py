import numpy as np
import pytest

from runtime.core.errors import ConfigurationError
from runtime.ipc.messages import Event, MergeResult
from runtime.motion.timeline import HELD, DimensionKinds
from runtime.processes.control.chunk_execution import build_strategy
from tests.runtime.tick_bench import Bench, following, wave


def merged(bench):
    return [message for message in bench.told() if isinstance(message, MergeResult)]


def speeds(bench):
    return np.abs(np.diff(bench.sent[:, 0]))


# --- the strategy -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["sync", "async", "ensemble", "naive", "rtc"])
def test_every_kind_of_strategy_is_made_from_its_section(kind):
    assert build_strategy({"kind": kind}, DimensionKinds()).kind == kind


@pytest.mark.parametrize(
    ("section", "said"),
    [
        ({}, r"strategy.kind = None; allowed: .*async.*sync"),
        ({"kind": "dance"}, "strategy.kind = 'dance'"),
        ({"kind": ["sync"]}, "strategy.kind"),
        ({"kind": "async", "blend_window": 0}, "strategy.blend_window"),
        ({"kind": "async", "windows": 3}, r"strategy.windows = 3"),
    ],
)
def test_what_is_no_strategy_is_refused_by_its_key(section, said):
    with pytest.raises(ConfigurationError, match=said):
        build_strategy(section, DimensionKinds())


# --- chunks -------------------------------------------------------------------------------------------------


def test_a_merged_chunk_says_by_which_strategy_and_over_how_many_steps():
    bench = following(Bench({"kind": "async", "blend_window": 6}))
    bench.run(9)
    bench.chunk(2, wave(60) + 0.01, step=0)
    bench.run(2)
    first, second = merged(bench)
    assert (first.strategy, first.overlap, first.delay) == ("async", 0, 0)
    assert (second.strategy, second.delay) == ("async", 10)
    assert 4 <= second.overlap <= 6


@pytest.mark.parametrize("rows", [np.zeros((0, 2)), np.zeros((5, 3)), np.zeros(2)])
def test_a_chunk_of_a_wrong_shape_is_dropped_by_name_and_control_goes_on(rows):
    bench = following(Bench())
    bench.chunk(2, rows)
    bench.run(3)
    assert "it has the shape" in merged(bench)[-1].dropped
    assert len(bench.sink.sent) == 4


NO_ROWS = np.zeros((0, 2))


@pytest.mark.some(12)
@pytest.mark.parametrize("mode", ["continuous", "step", "preview", "sim"])
@pytest.mark.parametrize("kind", ["sync", "async", "naive", "ensemble", "rtc"])
def test_a_run_of_whose_chunks_none_can_be_used_starves_and_holds(kind, mode):
    bench = Bench({"kind": kind})
    bench.say("follow", run=1, mode=mode)
    for number in range(1, 41):
        bench.chunk(number, NO_ROWS, waited=kind == "sync" or mode in ("step", "preview"))
        bench.run()
    assert [event.kind for event in bench.said()] == ["starved", "starvation"]


def test_one_useless_chunk_is_forgiven_where_the_next_is_none():
    bench = Bench({"kind": "sync"})
    bench.say("follow", run=1)
    bench.chunk(1, NO_ROWS, waited=True)
    bench.run(10)
    bench.chunk(2, wave(5), waited=True)
    bench.run(60)
    assert [event.kind for event in bench.said()] == ["starved", "recovered"]
    assert bench.status["waiting"]


def test_what_goes_wrong_with_one_chunk_drops_it_and_control_goes_on(monkeypatch, caplog):
    bench = following(Bench())
    monkeypatch.setattr("runtime.processes.control.chunk_execution.join", lambda *given, **more: [][0])
    bench.chunk(2, wave(60))
    bench.run(3)
    assert merged(bench)[-1].dropped == "control cannot use it: IndexError: list index out of range"
    assert "Traceback" in caplog.text
    assert len(bench.sink.sent) == 4


@pytest.mark.parametrize("kind", ["sync", "async", "naive", "ensemble", "rtc"])
def test_a_run_whose_first_action_is_far_takes_over_from_the_held_target(kind):
    bench = Bench({"kind": kind})
    bench.say("follow", run=1)
    bench.chunk(1, np.full((30, 2), 0.4), waited=kind == "sync")
    bench.run(20)
    assert speeds(bench).max() < 0.08
    assert bench.sent[0] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert bench.sent[-1] == pytest.approx([0.4, 0.4], abs=1e-6)
    records = bench.records()
    assert HELD in records[1].chunk_ids
    assert all(sum(record.weights) == pytest.approx(1.0) for record in records if record.chunk_ids)


def test_a_far_start_is_said_with_joint_and_distance_a_near_one_is_not():
    bench = following(Bench(), np.full((30, 2), 0.4))
    assert "a: the first action is 0.40 rad from where the robot stands" in bench.said("far_start")[0].text
    near = following(Bench(), np.full((30, 2), 0.2))
    assert near.said("far_start") == []


def test_a_later_chunk_of_sync_is_executed_as_it_is():
    bench = Bench({"kind": "sync"})
    bench.say("follow", run=1)
    bench.chunk(1, np.zeros((5, 2)), waited=True)
    bench.run(10)
    bench.chunk(2, np.full((5, 2), 0.06), waited=True)
    bench.run()
    assert bench.records()[-1].smoothed.tolist() == pytest.approx([0.06, 0.06])


def test_after_a_gap_the_next_chunk_takes_over_from_the_held_target():
    bench = following(Bench(), wave(5))
    bench.run(10)
    held = bench.sent[-1][0]
    bench.chunk(2, np.full((30, 2), held + 0.3))
    bench.run(12)
    assert np.diff(bench.sent[-13:, 0]).max() < 0.06
    assert bench.sent[-1][0] == pytest.approx(held + 0.3, abs=1e-5)
    assert bench.records()[-12].chunk_ids == [HELD]


def test_report_only_blends_nothing_in():
    bench = Bench(report_only=True)
    following(bench, np.full((5, 2), 0.4))
    assert bench.sent[0] == pytest.approx([0.4, 0.4])


# --- nothing planned ----------------------------------------------------------------------------------------


def test_status_tells_waiting_from_starving():
    bench = Bench()
    bench.say("follow", run=1)
    bench.run(3)
    assert (bench.status["waiting"], bench.status["starved"]) == (1, 0)  # for the first chunk
    bench.chunk(1, wave(3))
    bench.run()
    assert (bench.status["waiting"], bench.status["starved"]) == (0, 0)
    bench.run(4)
    assert (bench.status["waiting"], bench.status["starved"]) == (0, 1)
    bench.say("hold", run=1)
    bench.run()
    assert (bench.status["waiting"], bench.status["starved"]) == (0, 0)


@pytest.mark.parametrize("mode", ["step", "preview"])
def test_a_person_who_asks_for_each_chunk_is_waited_for(mode):
    bench = following(Bench(), wave(5), mode=mode)
    bench.run(90)
    assert bench.said() == []
    assert (bench.status["waiting"], bench.behaviour) == (1, "follow")
    assert (bench.sent[-1] == bench.sent[-2]).all()
    bench.chunk(2, wave(5, start=bench.sent[-1][0]), step=3, waited=True)
    bench.run(6)
    assert [len(record.chunk_ids) for record in bench.records()[-6:]] == [1] * 5 + [0]


@pytest.mark.parametrize(("answer", "ticks"), [("hold", 1), ("stop", 1), ("slow", 32)])
def test_starvation_is_answered_as_configured(answer, ticks):
    bench = Bench(starvation=answer)
    following(bench, wave(5, speed=1.5))
    bench.run(4)
    assert bench.said() == []
    bench.run(ticks)
    assert [event.kind for event in bench.said()] == ["starved", "starvation"]
    bench.run(20)
    assert bench.behaviour == "hold"
    steps = np.diff(bench.sent[4:, 0])
    assert (np.diff(steps) <= 1e-6).all()  # one stop, that slows down only and never begins anew
    assert (steps >= -1e-7).all()


# --- tuning -------------------------------------------------------------------------------------------------


def test_rows_already_planned_stay_when_the_strategy_is_switched():
    bench = following(Bench(), wave(40))
    bench.run(9)
    bench.tune("naive")
    bench.run(10)
    assert np.allclose(bench.sent, wave(20), atol=1e-6)
    assert [event.text for event in bench.said("tuned")] == ["chunks are merged by naive from now on"]


@pytest.mark.parametrize("kind", ["naive", "ensemble", "rtc"])
def test_the_first_chunk_after_a_switch_takes_over_from_the_old_plan_without_a_jump(kind):
    bench = following(Bench(), wave(60))
    bench.run(9)
    bench.tune(kind)
    bench.chunk(2, wave(60) + 0.3, step=0)
    bench.run(12)
    records = bench.records()
    assert np.diff([record.smoothed[0] for record in records]).max() < 0.08
    assert records[10].chunk_ids == [1]
    assert records[-1].chunk_ids == [2]
    assert all(sum(record.weights) == pytest.approx(1.0) for record in records)


def test_other_parameters_of_the_same_strategy_are_taken_over_and_nothing_is_joined():
    bench = following(Bench({"kind": "async", "blend_window": 8}), wave(60))
    bench.run(9)
    bench.tune("async", blend_window=1)
    bench.chunk(2, wave(60) + 0.04, step=0)
    bench.run()
    assert bench.records()[-1].chunk_ids == [2]


def test_switched_to_sync_what_is_planned_is_finished_and_then_it_waits():
    bench = following(Bench(), wave(20))
    bench.run(4)
    bench.tune("sync")
    bench.chunk(2, wave(20) + 0.1, step=0)  # asked while it moved
    bench.run(60)
    assert [message.dropped != "" for message in merged(bench)] == [False, True]
    assert bench.behaviour == "follow"
    assert bench.status["waiting"] == 1
    executed = [record.smoothed[0] for record in bench.records() if record.smoothed is not None]
    assert np.allclose(executed, wave(20)[:, 0], atol=1e-6)


@pytest.mark.parametrize("answer", ["slow", "hold"])
def test_switched_from_a_strategy_that_waits_the_next_chunk_is_no_gap(answer):
    bench = Bench({"kind": "sync"}, starvation=answer)
    bench.say("follow", run=1)
    bench.chunk(1, wave(5), waited=True)
    bench.run(20)
    bench.tune("async")
    bench.run(10)
    assert [event.kind for event in bench.said()] == ["tuned"]
    bench.chunk(2, np.full((30, 2), 0.3), step=bench.step - 2)
    bench.run(20)
    assert bench.said() == []
    assert np.diff(bench.sent[:, 0]).max() < 0.06
    assert bench.sent[-1][0] == pytest.approx(0.3, abs=1e-5)


def test_a_section_that_is_no_strategy_is_said_and_changes_nothing():
    bench = following(Bench(), wave(40))
    bench.tune("dance")
    bench.chunk(2, wave(40), step=0)
    bench.run()
    told = bench.told()
    kinds = [message.kind for message in told if isinstance(message, Event)]
    assert kinds == ["tune_refused"]
    assert [m.strategy for m in told if isinstance(m, MergeResult)] == ["async", "async"]


def test_a_strategy_that_was_chosen_between_runs_is_that_of_the_next_run():
    bench = Bench()
    bench.tune("naive")
    following(bench)
    assert merged(bench)[0].strategy == "naive"


# --- angles that wrap ---------------------------------------------------------------------------------------


def test_an_angle_without_limits_goes_on_in_its_turn_and_never_unwinds():
    """The policy and the node count the angle within one turn; what is sent goes on counting."""
    limits_of = Bench().limits
    endless = type(limits_of)(
        ("turning", "b"),
        np.array([-np.inf, -2.0]),
        np.array([np.inf, 2.0]),
        limits_of.velocity,
        limits_of.grippers,
        limits_of.binary,
    )
    bench = Bench(limits=endless, dims=DimensionKinds(wrapping=(0,)))
    angle = 3.0 + 0.02 * np.arange(120)
    rows = np.column_stack([(angle + np.pi) % (2 * np.pi) - np.pi, np.zeros(120)])
    bench.measured = np.array([3.0, 0.0])
    bench.say("follow", run=1)
    for tick in range(60):
        if tick % 10 == 0:
            bench.chunk(1 + tick, rows[tick : tick + 20])
        bench.moved_by_hand = np.array([(angle[tick] + np.pi) % (2 * np.pi) - np.pi, 0.0])
        bench.run()
    assert np.allclose(bench.sent[:, 0], angle[:60], atol=1e-5)
    bench.say("hold", run=1)
    bench.run(30)
    assert bench.said() == []  # not displaced by a whole turn
    assert bench.sent[-1, 0] > angle[59]
