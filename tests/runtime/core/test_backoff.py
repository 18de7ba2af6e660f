"""When to try again."""

from __future__ import annotations

import pytest

from runtime.core.backoff import BackOff


def test_it_waits_twice_as_long_after_every_failure_up_to_a_bound() -> None:
    back_off, now, waits = BackOff(), 100.0, []
    for _ in range(7):
        back_off.record_failure(now)
        waits.append(back_off.remaining_delay(now))
        now += waits[-1]
    assert waits == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.6, 2.0, 2.0])
    assert back_off.remaining_delay(now) == pytest.approx(0.0)
    assert back_off.failing_for(now) == pytest.approx(sum(waits))


def test_a_success_forgets_the_failures() -> None:
    back_off = BackOff()
    for now in (1.0, 2.0, 3.0):
        back_off.record_failure(now)
    back_off.reset()
    assert (back_off.remaining_delay(3.0), back_off.failing_for(9.0), back_off.since) == (0.0, 0.0, None)
    back_off.record_failure(10.0)
    assert back_off.remaining_delay(10.0) == pytest.approx(0.1)
