import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.clock import ClockMap, MonotonicClock, VirtualClock

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
