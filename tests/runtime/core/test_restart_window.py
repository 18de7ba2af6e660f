"""How often a process that keeps ending is restarted."""

from __future__ import annotations

from runtime.core.restart_window import MOST_RESTARTS, RESTART_WINDOW_S, RestartWindow


def test_no_more_restarts_than_the_bound_are_admitted_within_the_window() -> None:
    window = RestartWindow()
    assert [window.admit(100.0 + number) for number in range(MOST_RESTARTS + 1)] == [*[True] * 5, False]
    assert not window.admit(100.0 + RESTART_WINDOW_S), "the first counts until a minute has passed"
    assert window.admit(100.5 + RESTART_WINDOW_S)
    assert not window.admit(100.5 + RESTART_WINDOW_S)


def test_a_refused_restart_does_not_count() -> None:
    window = RestartWindow()
    admitted = [window.admit(0.0) for _ in range(2 * MOST_RESTARTS)]
    assert sum(admitted) == MOST_RESTARTS
    assert window.admit(RESTART_WINDOW_S + 0.1)


def test_cleared_it_begins_anew() -> None:
    window = RestartWindow()
    while window.admit(0.0):
        pass
    window.clear()
    assert [window.admit(0.0) for _ in range(MOST_RESTARTS + 1)] == [*[True] * 5, False]
