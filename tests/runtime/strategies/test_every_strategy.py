"""What holds for every strategy, whatever the delays, driven step by step on integers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.step_loop import StepLoop
from runtime.core.plugins import variants
from runtime.motion.timeline import HELD, DimensionKinds
from runtime.strategies.base import JOIN_WINDOW
from tests.examples import some

STRATEGIES = variants("runtime.strategies")
KINDS = sorted(STRATEGIES)
MOVING = sorted(set(KINDS) - {"sync"})
RATE = 30.0
DIMS = DimensionKinds(switched=(1,))
GRIPPER = 0.05

delays = st.lists(st.integers(0, 9), min_size=1, max_size=12)
parameters = st.fixed_dictionaries(
    {},
    optional={
        "inference_rate": st.sampled_from([1.0, 3.0, 10.0]),
        "blend_window": st.integers(1, 30) | st.just("all"),
        "blend_shape": st.sampled_from(["linear", "cosine", "exponential"]),
        "k_max": st.integers(0, 12),
        "execution_horizon": st.integers(10, 60),
        "ensemble_m": st.sampled_from([0.0, 0.01, 1.0]),
        "ensemble_horizon": st.integers(1, 9),
    },
)


def config(kind, **given):
    return STRATEGIES[kind].Config(**given)


def cycling(values):
    return lambda number: values[(number - 1) % len(values)]


def consistent(horizon):
    """A policy whose action for a step is that step's number."""
    return lambda step, _: np.arange(step, step + horizon, dtype=float)[:, None]


def moody(horizon, seed):
    """A policy whose chunks disagree, and whose gripper is open or closed at random."""
    random = np.random.default_rng(seed)

    def rows(step, _):
        arm = random.uniform(-1, 1) + 0.02 * np.arange(horizon)
        return np.column_stack([arm, GRIPPER * random.integers(0, 2, horizon)])

    return rows


def loop(kind, policy, delay, start=0.0, dim=1, dims=None, **given):
    begin = np.full(dim, start)
    return StepLoop(STRATEGIES[kind], config(kind, **given), policy, cycling(delay), RATE, begin, dims)


@pytest.mark.some(2)
@pytest.mark.parametrize("kind", MOVING)
@given(delays, st.none() | st.sampled_from([1.0, 3.0, 10.0]), st.integers(45, 60))
@settings(max_examples=some(40))
def test_the_action_published_for_a_step_is_exactly_the_one_meant_for_it(kind, delay, rate, horizon):
    log = loop(kind, consistent(horizon), delay, inference_rate=rate).run(150)
    followed = log.executed[delay[0] + JOIN_WINDOW :]  # once it has caught up from where it stood
    assert all(tick.action[0] == tick.step for tick in followed)


@given(delays, st.none() | st.integers(1, 60), st.integers(1, 40))
@settings(max_examples=some(40))
def test_sync_executes_every_action_in_order_and_nothing_else(delay, cropped, horizon):
    driven = loop("sync", consistent(horizon), delay, execution_horizon=cropped)
    log = driven.run(150)
    placed = {merged.chunk_id: merged for merged in log.merged}
    moving = [tick for tick in log.executed if tick.makers]
    for tick in moving:
        ((chunk, _),) = tick.makers
        row = tick.step - placed[chunk].arrival_step
        assert tick.action[0] == log.observed[chunk] + row
        assert 0 <= row < min(horizon, cropped or horizon)
    assert all(not merged.dropped and not merged.mistimed for merged in log.merged)
    count = min(horizon, cropped or horizon)
    finished = [merged for merged in log.merged if merged.arrival_step + count <= 150]
    assert len(moving) >= count * len(finished)


@pytest.mark.parametrize("kind", MOVING)
@given(delays, st.none() | st.sampled_from([1.0, 3.0, 10.0]))
@settings(max_examples=some(25))
def test_nothing_starves_while_the_horizon_covers_delay_and_query_interval(kind, delay, rate):
    interval = max(max(delay) + 1, 0 if rate is None else int(np.ceil(RATE / rate)))
    horizon = max(delay) + interval + 1
    log = loop(kind, moody(horizon, 1), delay, dim=2, dims=DIMS, inference_rate=rate).run(150)
    assert not any(tick.starved for tick in log.executed)
    assert not any(merged.dropped for merged in log.merged)


@pytest.mark.parametrize("kind", KINDS)
@given(
    st.lists(st.integers(0, 30), min_size=1, max_size=12),
    parameters,
    st.integers(1, 25),
    st.lists(st.tuples(st.integers(0, 40), st.sampled_from(KINDS), parameters), max_size=3),
    st.integers(0, 9),
)
@settings(max_examples=some(40))
def test_whatever_is_asked_of_it_live_the_plan_stays_sound(kind, delay, given, horizon, switches, seed):
    driven = loop(kind, moody(horizon, seed), delay, dim=2, dims=DIMS, **given)
    kinds = {kind}
    for ticks, other, changed in switches:
        driven.run(ticks)
        driven.tune(STRATEGIES[other], config(other, **changed))
        kinds.add(other)
    log = driven.run(60)
    _assert_made_soundly(log)
    _assert_placed_soundly(log, horizon)
    assert len(driven.timeline.rows) <= horizon
    assert len(driven.timeline.laid) <= 9


def _assert_made_soundly(log):
    used = {}
    for merged in log.merged:
        used[merged.chunk_id] = set(merged.targets[merged.targets >= 0].tolist())
    for tick in log.executed:
        assert tick.action[1] in (0.0, GRIPPER)
        assert np.isfinite(tick.action).all()
        if tick.makers:
            shares = [share for _, share in tick.makers]
            assert sum(shares) == pytest.approx(1.0, abs=1e-12)
            assert min(shares) > 0.0
        assert all(maker == HELD or tick.step in used[maker] for maker, _ in tick.makers)


def _assert_placed_soundly(log, horizon):
    for merged in log.merged:
        rows = np.flatnonzero(merged.targets >= 0)
        assert len(merged.targets) == horizon
        assert bool(merged.dropped) == (len(rows) == 0)
        assert merged.targets[rows].tolist() == list(
            range(merged.arrival_step, merged.arrival_step + len(rows))
        )
        assert merged.delay == merged.arrival_step - log.observed[merged.chunk_id]


@pytest.mark.some(30)
@pytest.mark.parametrize("new", KINDS)
@pytest.mark.parametrize("old", KINDS)
@pytest.mark.parametrize("when", [11, 37])
@pytest.mark.parametrize("rate", [None, 3.0])
def test_a_switch_while_running_never_jumps(old, new, when, rate):
    """The first chunk that the new strategy merges is off by 1: the worst that it can find."""

    def driven_to(turn):
        driven = loop(old, lambda step, _: np.full((20, 1), float(step >= turn)), [3], inference_rate=rate)
        driven.run(when)
        return driven

    log = driven_to(999).log
    flying = set(log.observed) - {merged.chunk_id for merged in log.merged}
    driven = driven_to(log.observed[flying.pop()] if flying else when)
    driven.tune(STRATEGIES[new], config(new, inference_rate=rate))
    log = driven.run(60)
    actions = np.array([tick.action[0] for tick in log.executed])
    first = next(m for m in log.merged if m.arrival_step >= when and not m.dropped)
    assert actions[first.arrival_step - 1] == 0.0
    assert actions[-1] == 1.0
    if old != new:
        assert actions[first.arrival_step] == 0.0
        assert np.abs(np.diff(actions)).max() <= 1 / 7 + 1e-9
    assert not any(tick.starved for tick in log.executed)


@pytest.mark.parametrize("old", MOVING)
def test_to_sync_what_is_planned_is_finished_first_and_its_waiting_is_no_starvation(old):
    driven = loop(old, consistent(20), [3])
    driven.run(30)
    planned = driven.timeline.remaining(30)
    driven.tune(STRATEGIES["sync"], config("sync"))
    log = driven.run(60)
    after = [bool(tick.makers) for tick in log.executed[30:]]
    assert after[: planned + 1] == [True] * planned + [False]
    assert [tick.action[0] for tick in log.executed[30 : 30 + planned]] == list(range(30, 30 + planned))
    late = [merged for merged in log.merged if merged.arrival_step >= 30]
    assert "finished first" in late[0].dropped
    assert not late[1].dropped
    assert not any(tick.starved for tick in log.executed)


@pytest.mark.parametrize("kind", MOVING)
def test_chunks_that_lie_in_the_past_are_dropped_and_the_next_usable_one_is_followed(kind):
    driven = loop(kind, consistent(16), [2, 2, 25, *[2] * 30])
    log = driven.run(80)
    past = [merged for merged in log.merged if merged.dropped]
    starved = [tick.step for tick in log.executed if tick.starved]
    assert [merged.chunk_id for merged in past] == [3]
    assert starved == list(range(starved[0], starved[-1] + 1))
    back = starved[-1] + 1
    assert log.executed[back].makers == ((HELD, 1.0),)
    assert all(tick.action[0] == tick.step for tick in log.executed[back + JOIN_WINDOW :])


@pytest.mark.parametrize("kind", MOVING)
def test_a_policy_that_is_always_too_late_starves_and_is_asked_again_and_again(kind):
    log = loop(kind, consistent(5), [9]).run(100)
    assert len(log.merged) == 10
    assert all(merged.dropped for merged in log.merged)
    assert all(tick.starved for tick in log.executed[9:])


@pytest.mark.parametrize("kind", MOVING)
def test_a_shift_by_k_max_is_recorded_as_mistimed_by_as_much_as_it_is(kind):
    log = loop(kind, consistent(30), [5], k_max=2).run(60)
    assert {merged.mistimed for merged in log.merged} == {3}
    late = {tick.step - tick.action[0] for tick in log.executed[20:]}
    assert late == {3.0}


@pytest.mark.parametrize("kind", ["async", "rtc"])
def test_the_window_all_follows_a_consistent_policy_exactly_too(kind):
    log = loop(kind, consistent(40), [3, 0, 7], blend_window="all").run(100)
    assert all(tick.action[0] == tick.step for tick in log.executed[3 + JOIN_WINDOW :])


@pytest.mark.parametrize(
    ("kind", "given", "least", "most"),
    [("naive", {}, 3, 3), ("async", {}, 9, 10), ("async", {"blend_window": "all"}, 30, 40)],
)
def test_what_a_window_costs_when_the_policy_changes_its_mind(kind, given, least, most):
    """Pitfall 4: 30 Hz, 3 Hz inference, 3 ticks of delay, 50 rows; the mind is changed as it is asked."""
    driven = loop(kind, lambda step, _: np.full((50, 1), float(step >= 60)), [3], inference_rate=3.0, **given)
    actions = np.array([tick.action[0] for tick in driven.run(140).executed])
    assert least <= np.argmax(actions >= 0.99) - 60 <= most


@pytest.mark.parametrize("kind", KINDS)
def test_an_angle_that_goes_round_and_round_never_turns_back(kind):
    """The policy answers within half a turn either way; the commands go on, whatever the branch of an answer."""

    def policy(step, _):
        angle = 0.1 * np.arange(step, step + 40)
        return ((angle + np.pi) % (2 * np.pi) - np.pi)[:, None]

    log = loop(kind, policy, [3, 1, 5], dims=DimensionKinds(wrapping=(0,))).run(200)
    steps = np.diff([tick.action[0] for tick in log.executed if tick.makers][JOIN_WINDOW:])
    assert steps.min() > 0.0
    assert steps.max() < 1.0
    if kind != "sync":
        np.testing.assert_allclose(steps, 0.1, atol=1e-6)
