import random
import time
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.core.clock import ClockMap, MonotonicClock, VirtualClock

DELAYS = st.lists(st.floats(0.0, 0.3), min_size=1, max_size=60)


def test_the_real_clock_is_the_machines_monotonic_clock():
    before = time.monotonic()
    assert before <= MonotonicClock().now() <= time.monotonic()


def test_the_real_clock_never_wakes_before_its_deadline():
    clock = MonotonicClock()
    deadline = clock.now() + 0.005
    clock.sleep_until(deadline)
    assert clock.now() >= deadline


def test_a_deadline_that_has_passed_is_no_wait():
    clock, slept = MonotonicClock(), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(time, "sleep", slept.append)
        clock.sleep_until(clock.now() - 5.0)
    assert slept == []


def test_a_virtual_clock_moves_only_when_told():
    clock = VirtualClock(10.0)
    assert clock.now() == clock.now() == 10.0
    clock.sleep_until(12.5)
    assert clock.now() == 12.5
    clock.advance(0.5)
    assert clock.now() == 13.0


def test_a_virtual_clock_does_not_go_back_for_an_old_deadline():
    clock = VirtualClock(10.0)
    clock.sleep_until(3.0)
    assert clock.now() == 10.0


@pytest.mark.parametrize("seconds", [-0.1, float("nan")])
def test_a_virtual_clock_refuses_to_go_back(seconds):
    clock = VirtualClock(10.0)
    with pytest.raises(ValueError, match="does not go backwards"):
        clock.advance(seconds)
    assert clock.now() == 10.0


@given(offset=st.floats(-1e6, 1e6), delays=DELAYS)
def test_a_mapped_stamp_is_never_later_than_its_arrival(offset, delays):
    clock_map = ClockMap()
    for index, delay in enumerate(delays):
        sent = 1000.0 + index / 30
        arrival = sent + delay
        assert clock_map.map(sent - offset, arrival) <= arrival


@given(offset=st.floats(-1e4, 1e4), delays=DELAYS)
def test_the_map_is_wrong_by_the_smallest_delay_it_has_seen(offset, delays):
    clock_map = ClockMap()
    for index, delay in enumerate(delays):
        sent = 1000.0 + index / 30
        mapped = clock_map.map(sent - offset, sent + delay)
        assert mapped - sent == pytest.approx(min(delays[: index + 1]), abs=1e-6)


def test_a_clock_that_drifts_is_followed_over_the_window():
    clock_map, drift = ClockMap(window=30.0), 50e-6
    for second in range(3600):
        sent = float(second)
        mapped = clock_map.map(sent * (1 + drift), sent + 0.002)
    # With the minimum of the whole hour it would be off by 180 ms.
    assert mapped - sent == pytest.approx(0.002, abs=30 * drift)


def test_a_slow_clock_is_not_tied_to_a_minimum_of_long_ago():
    clock_map, drift = ClockMap(window=30.0), -50e-6
    for second in range(3600):
        sent = float(second)
        mapped = clock_map.map(sent * (1 + drift), sent + 0.002)
    assert mapped - sent == pytest.approx(0.002, abs=31 * abs(drift))


def test_a_restarted_peer_with_a_smaller_clock_counts_at_once():
    clock_map = ClockMap()
    clock_map.map(5000.0, 100.0)
    assert clock_map.map(1.0, 101.0) == pytest.approx(101.0)
    assert clock_map.restarts == 1
    assert clock_map.map(1.5, 101.6) == pytest.approx(101.5)
    assert clock_map.restarts == 1


def test_two_stamps_out_of_order_are_no_restart():
    clock_map = ClockMap(tolerance=0.5)
    clock_map.map(10.0, 100.0)
    assert clock_map.map(9.9, 100.001) == pytest.approx(99.9)
    assert clock_map.restarts == 0


def test_a_peer_whose_clock_leaps_ahead_is_followed_at_once():
    clock_map = ClockMap()
    clock_map.map(10.0, 100.0)
    assert clock_map.map(1010.0, 100.1) == pytest.approx(100.1)
    assert (clock_map.restarts, clock_map.leaps) == (0, 1)
    assert clock_map.map(1010.1, 100.3) == pytest.approx(100.2)
    assert clock_map.leaps == 1


def test_messages_that_were_held_up_and_come_at_once_are_no_leap():
    clock_map = ClockMap(tolerance=0.1)
    clock_map.map(10.0, 100.0)
    for stamp in (10.1, 10.5, 11.0, 12.0):
        assert clock_map.map(stamp, 102.0) == pytest.approx(stamp + 90)
    assert (clock_map.restarts, clock_map.leaps) == (0, 0)


@given(
    offset=st.floats(-1e6, 1e6),
    delays=DELAYS,
    jump=st.floats(0.9, 1e6) | st.floats(-1e6, -0.2),
    after=st.integers(1, 40),
)
def test_a_jump_of_any_size_is_counted_once_and_the_map_is_right_again_at_once(offset, delays, jump, after):
    clock_map = ClockMap(tolerance=0.1)
    seen = []
    for index, delay in enumerate([*delays, *delays]):
        sent = 1000.0 + index / 30
        stamp = sent - offset + (jump if index >= after else 0.0)
        seen.append(delay)
        if index == after:
            seen = [delay]
        mapped = clock_map.map(stamp, sent + delay)
        if index >= after or jump > 0:
            assert mapped - sent == pytest.approx(min(seen), abs=1e-6)
    jumped = after < 2 * len(delays)
    counted = (clock_map.leaps, clock_map.restarts)
    assert counted == ((jumped, 0) if jump > 0 else (0, jumped))


# --- steps of any size ---------------------------------------------------------------------------------------

JITTER_S = 0.003  # of the way, and by a twentieth of its period of the node
RATES = st.sampled_from([10.0, 30.0, 30.0, 100.0, 200.0])
STEPS = st.one_of(st.floats(0.03, 0.5), st.floats(0.5, 1e6), st.sampled_from([1 / 30, 0.1, 0.2, 0.3]))


class Stream:
    """What a node stamps, and when it arrives: in its order, never before the way's least time."""

    def __init__(self, rate: float, seed: int, drift: float = 0.0) -> None:
        self.rate, self.random, self.drift = rate, random.Random(seed), drift
        self.sent = self.arrived = 1000.0
        self.offset = 0.0  # of the node's clock
        self.blocked_until = 0.0  # the way

    def messages(self, seconds: float, lost: float = 0.0) -> Iterator[tuple[float, float, float]]:
        """(sent on our clock, stamp, arrival) for so long, a part of them `lost`."""
        end = self.sent + seconds
        while self.sent < end:
            self.sent += (1.0 + self.random.uniform(-0.05, 0.05)) / self.rate
            if self.random.random() < lost:
                continue
            on_time = self.sent + 0.001 + self.random.uniform(0.0, JITTER_S)
            self.arrived = max(on_time, self.arrived, self.blocked_until)
            yield self.sent, self.sent * (1.0 + self.drift) + self.offset, self.arrived

    def block(self, seconds: float) -> None:
        """Nothing arrives for so long, and then all at once."""
        self.blocked_until = self.sent + seconds


@given(
    rate=RATES,
    step=STEPS,
    back=st.booleans(),
    seed=st.integers(0, 1 << 16),
    drift=st.floats(-1e-4, 1e-4),
    before=st.floats(1.5, 4.0),
)
def test_a_step_of_any_size_is_counted_once_and_ages_nothing_for_longer_than_0_3_s(
    rate, step, back, seed, drift, before
):
    clock_map, stream = ClockMap(tolerance=0.1), Stream(rate, seed, drift)
    for _, stamp, arrival in stream.messages(before):
        clock_map.map(stamp, arrival)
    assert (clock_map.restarts, clock_map.leaps) == (0, 0)
    stream.offset, stepped = -step if back else step, stream.sent
    for sent, stamp, arrival in stream.messages(3.0):
        mapped = clock_map.map(stamp, arrival)
        if sent > stepped + 0.3:
            assert mapped - sent == pytest.approx(0.001, abs=2 * JITTER_S)
    assert (clock_map.restarts, clock_map.leaps) == ((1, 0) if back else (0, 1))


@given(
    rate=RATES,
    seed=st.integers(0, 1 << 16),
    blocks=st.lists(st.tuples(st.floats(0.1, 2.0), st.floats(0.01, 1.5)), max_size=6),
    lost=st.sampled_from([0.0, 0.0, 0.1]),
    drift=st.floats(-1e-4, 1e-4),
)
def test_what_comes_late_and_in_bursts_is_as_old_as_it_is_and_no_step(rate, seed, blocks, lost, drift):
    clock_map, stream = ClockMap(tolerance=0.1), Stream(rate, seed, drift)
    for quiet, blocked in [(1.5, 0.0), *blocks, (1.0, 0.0)]:
        for sent, stamp, arrival in stream.messages(quiet, lost):
            mapped = clock_map.map(stamp, arrival)
            assert mapped - sent <= 0.001 + 2 * JITTER_S, "a late message was believed to be fresh"
        stream.block(blocked)
    assert (clock_map.restarts, clock_map.leaps) == (0, 0)


@pytest.mark.parametrize("step", [0.05, 0.08, 0.3])
def test_a_clock_set_back_while_nothing_came_is_noticed_by_what_comes_then(step):
    clock_map, stream = ClockMap(tolerance=0.1), Stream(30.0, 1)
    for _, stamp, arrival in stream.messages(2.0):
        clock_map.map(stamp, arrival)
    stream.sent += 5.0
    stream.offset = -step
    for _, stamp, arrival in stream.messages(1.3):
        mapped = clock_map.map(stamp, arrival)
    assert mapped - stream.sent == pytest.approx(0.001, abs=2 * JITTER_S)
    assert clock_map.restarts == 1


def test_two_that_stamp_one_stream_are_no_clock_that_goes_to_and_fro():
    clock_map, first, second = ClockMap(), Stream(30.0, 1), Stream(30.0, 2)
    second.offset = -0.04
    for one, other in zip(first.messages(3.0), second.messages(3.0), strict=False):
        clock_map.map(*one[1:])
        clock_map.map(*other[1:])
    assert (clock_map.restarts, clock_map.leaps) == (0, 0)
