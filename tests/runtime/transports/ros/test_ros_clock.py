from __future__ import annotations

import pytest

from runtime.transports.ros.alignment import RosClock

WALL = 1_800_000_000.0  # s, a stamp of wall time, far from our clock


def test_every_stream_keeps_its_own_delay() -> None:
    clock = RosClock()
    for tick in range(10):
        made = WALL + tick / 10
        assert clock.to_monotonic("joints", made, 50 + tick / 10 + 0.002) == pytest.approx(50.002 + tick / 10)
        # The camera's picture is as old as it is, although it took 120 ms to come.
        assert clock.to_monotonic("camera", made, 50 + tick / 10 + 0.120) == pytest.approx(50.002 + tick / 10)
    assert (clock.backwards, clock.forwards) == (0, 0)


def test_a_stamp_is_never_later_than_its_arrival() -> None:
    clock = RosClock()
    clock.to_monotonic("joints", WALL, 50.0)
    for stamp, arrival in ((WALL + 0.3, 50.1), (WALL + 0.35, 50.2), (WALL + 1.1, 51.3)):
        ours = clock.to_monotonic("joints", stamp, arrival)
        assert ours <= arrival
    assert ours == pytest.approx(50.9)  # by the shortest way that a message has taken


def test_a_clock_that_goes_back_is_counted_and_mapped_anew() -> None:
    clock = RosClock()
    clock.to_monotonic("joints", WALL, 50.0)
    assert clock.to_monotonic("joints", WALL - 3600, 50.1) == pytest.approx(50.1)
    assert clock.backwards == 1
    assert clock.to_monotonic("joints", WALL - 3599.9, 50.2) == pytest.approx(50.2)
    assert clock.backwards == 1


def test_a_clock_that_leaps_ahead_is_counted_and_mapped_at_once() -> None:
    clock = RosClock()
    clock.to_monotonic("joints", WALL, 50.0)
    assert clock.to_monotonic("joints", WALL + 3600, 50.1) == pytest.approx(50.1)
    assert (clock.backwards, clock.forwards) == (0, 1)


def test_a_slow_camera_is_no_clock_that_goes_back() -> None:
    clock = RosClock()
    for tick in range(20):
        clock.to_monotonic("joints", WALL + tick / 10, 50 + tick / 10)
        if tick >= 10:
            clock.to_monotonic("camera", WALL + tick / 10 - 0.9, 50 + tick / 10)
    assert (clock.backwards, clock.forwards) == (0, 0)


@pytest.mark.parametrize(("step", "counted"), [(-0.2, (1, 0)), (0.2, (0, 1))])
def test_a_small_step_is_one_however_many_streams_show_it(step: float, counted: tuple[int, int]) -> None:
    clock = RosClock()
    for tick in range(90):
        now, offset = 50 + tick / 30, WALL - 50 + (step if tick >= 60 else 0.0)
        joints = clock.to_monotonic("joints", now + offset, now + 0.002)
        clock.to_monotonic("camera", now + offset, now + 0.030)
    assert joints == pytest.approx(now + 0.002)
    assert (clock.backwards, clock.forwards) == counted


def test_a_silence_is_no_leap() -> None:
    clock = RosClock()
    clock.to_monotonic("joints", WALL, 50.0)
    clock.to_monotonic("joints", WALL + 30, 80.0)
    assert (clock.backwards, clock.forwards) == (0, 0)
