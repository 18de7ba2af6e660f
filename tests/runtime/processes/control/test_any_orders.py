"""Whatever the coordinator posts, in whatever order: what control sends stays within limits, and is accounted for."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.ipc.shared_state import EStop
from tests.examples import some
from tests.runtime.tick_bench import PERIOD, WITH_GRIPPER, Bench

TOP = WITH_GRIPPER.velocity
RATE = 60.0 * WITH_GRIPPER.radian_scale
NAN = float("nan")

numbers = st.floats(-2.5, 2.5)
few = st.integers(1, 12)
orders = st.one_of(
    st.tuples(st.just("hold"), st.integers(0, 2)),
    st.tuples(st.just("silent"), st.just(0)),
    st.tuples(
        st.just("follow"), st.integers(1, 2), st.sampled_from(["continuous", "step", "preview", "sim"])
    ),
    st.tuples(
        st.just("motion"), st.integers(0, 2), st.tuples(numbers, numbers, numbers), st.floats(0.01, 1.0)
    ),
)
chunks = st.tuples(
    st.just("chunk"),
    st.integers(1, 2),  # run
    st.integers(1, 25),  # rows
    st.integers(-3, 30),  # how long ago it was asked
    st.booleans(),  # waited
    st.tuples(
        numbers, st.floats(-4.0, 4.0), st.sampled_from([0.0, 0.02, 0.1, 0.5, NAN])
    ),  # from, speed, gripper
)
others = st.one_of(
    st.tuples(
        st.just("tune"), st.sampled_from(["sync", "async", "naive", "ensemble", "rtc"]), st.integers(1, 12)
    ),
    st.tuples(st.just("lock"), st.sampled_from([NAN, 0.0, 0.04, 0.1, 0.3])),
    st.tuples(st.just("estop"), st.sampled_from([EStop.LATCHED, EStop.CLEAR])),
    st.tuples(st.just("feed"), st.booleans()),
    st.tuples(st.just("alive"), st.booleans()),
)
happenings = st.lists(st.tuples(st.one_of(orders, chunks, chunks, others), few), min_size=1, max_size=25)


def happen(bench, number, what):
    kind, *rest = what
    if kind in ("hold", "silent"):
        bench.say(kind, run=rest[0])
    elif kind == "follow":
        bench.say(kind, run=rest[0], mode=rest[1])
    elif kind == "motion":
        bench.say(kind, run=rest[0], goal=np.array(rest[1]), speed=rest[2])
    elif kind == "chunk":
        run, count, ago, waited, (start, speed, gripper) = rest
        line = start + speed * PERIOD * np.arange(count)
        rows = np.column_stack([line, -line, np.full(count, gripper)])
        bench.chunk(number, rows, step=bench.step - ago, run=run, waited=waited)
    elif kind == "tune":
        options = {"blend_window": rest[1]} if rest[0] in ("async", "rtc") else {}
        bench.tune(rest[0], **options)
    elif kind == "lock":
        bench.lock(NAN, NAN, rest[0])
    elif kind == "estop":
        bench.shared.set_estop(rest[0])
    else:
        setattr(bench, kind, rest[0])


class Witness:
    """Looks at the bench after every tick."""

    def __init__(self, bench):
        self.bench = bench
        self.before = bench.measured.copy()
        self.speed = np.zeros(3)
        self.told = 0

    def __call__(self):
        bench = self.bench
        record, status = bench.records()[-1], bench.status
        sent = bench.sent[self.told :]
        self.told += len(sent)
        assert len(sent) <= 1
        assert len(sent) == int(status["engaged"])  # an engaged robot is told something on every tick
        self.weigh(record)
        stopped = bench.shared.estop is EStop.LATCHED
        if stopped:
            assert status["estop_obeyed"]
            assert not status["moving"]
            assert np.isnan(status["simulated"]).all()
            assert record.source in ("estop", "none")
        if record.source == "sim":
            assert not status["moving"]
        if len(sent):
            self.follow(sent[0], stopped)

    def weigh(self, record):
        assert len(record.chunk_ids) == len(record.weights)
        if record.chunk_ids:
            assert sum(record.weights) == pytest.approx(1.0)
            assert min(record.weights) > 0
            assert len(set(record.chunk_ids)) == len(record.chunk_ids)

    def follow(self, sent, stopped):
        """What was sent is reachable from what was sent before; the e-stop goes to where the robot was last seen."""
        speed = (sent - self.before) / PERIOD
        assert (sent >= WITH_GRIPPER.lower - 1e-5).all()
        assert (sent <= WITH_GRIPPER.upper + 1e-5).all()
        if stopped:
            assert (np.abs(sent - self.before) <= TOP * 0.2 + 1e-6).all()  # as old as joints may be
            speed = np.zeros(3)
        else:
            assert (np.abs(speed) <= TOP + 1e-3).all()
            assert (np.abs(speed - self.speed) <= RATE * PERIOD + 1e-2).all()
        self.before, self.speed = sent, speed


@settings(max_examples=some(80))
@given(happenings, st.sampled_from(["slow", "hold", "stop"]))
def test_what_is_sent_is_within_limits_and_weights_sum_to_one(happening, starvation):
    bench = Bench(limits=WITH_GRIPPER, starvation=starvation)
    bench.measured = np.array([0.1, -0.1, 0.05])
    witness = Witness(bench)
    for number, (what, ticks) in enumerate(happening, 1):
        happen(bench, number, what)
        for _ in range(ticks):
            bench.run()
            witness()


only_simulation = st.one_of(
    st.tuples(st.just("follow"), st.integers(1, 2), st.just("sim")),
    st.tuples(st.just("hold"), st.integers(0, 2)),
    chunks,
    others,
)


@settings(max_examples=some(40))
@given(st.lists(st.tuples(only_simulation, few), min_size=1, max_size=20), st.booleans())
def test_nothing_of_a_simulation_is_ever_sent(happening, engaged):
    """A silent robot hears of an e-stop at most; one that is held is held where it was, but for a lock's gripper."""
    bench = Bench(limits=WITH_GRIPPER)
    bench.measured = np.array([0.1, -0.1, 0.05])
    if engaged:
        bench.say("motion", goal=bench.measured.copy())
        bench.run(2)
    begun = len(bench.sink.sent)
    pressed = False
    for number, (what, ticks) in enumerate(happening, 1):
        pressed = pressed or what == ("estop", EStop.LATCHED)
        happen(bench, number, what)
        bench.run(ticks)
    arms = bench.sent[begun:, :2]
    assert arms == pytest.approx(np.tile([0.1, -0.1], (len(arms), 1)), abs=1e-6)
    if not engaged and not pressed:
        assert len(arms) == 0


@settings(max_examples=some(40))
@given(happenings, st.sampled_from([0.0, 0.04, 0.1]))
def test_a_locked_gripper_comes_to_its_place_and_stays_there(happening, at):
    bench = Bench(limits=WITH_GRIPPER)
    bench.measured = np.array([0.1, -0.1, 0.05])
    bench.say("motion", goal=bench.measured.copy())
    bench.lock(NAN, NAN, at)
    bench.run(25)
    assert bench.sent[-1, 2] == pytest.approx(at, abs=1e-5)
    told = len(bench.sink.sent)
    for number, (what, ticks) in enumerate(happening, 1):
        if what[0] not in ("lock", "silent", "estop"):  # the e-stop forgets all locks
            happen(bench, number, what)
        bench.run(ticks)
    assert bench.sent[told:, 2] == pytest.approx(at, abs=1e-5)
