"""When to try again."""

from __future__ import annotations

import pytest

from runtime.core.backoff import BackOff


def test_it_waits_twice_as_long_after_every_failure_up_to_a_bound() -> None:
    back_off, now, waits = BackOff(), 100.0, []
    for _ in range(7):
        back_off.failed(now)
        waits.append(back_off.waiting(now))
        now += waits[-1]
    assert waits == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.6, 2.0, 2.0])
    assert back_off.waiting(now) == pytest.approx(0.0)
    assert back_off.lasts(now) == pytest.approx(sum(waits))


def test_a_success_forgets_the_failures() -> None:
    back_off = BackOff()
    for now in (1.0, 2.0, 3.0):
        back_off.failed(now)
    back_off.forget()
    assert (back_off.waiting(3.0), back_off.lasts(9.0), back_off.since) == (0.0, 0.0, None)
    back_off.failed(10.0)
    assert back_off.waiting(10.0) == pytest.approx(0.1)
