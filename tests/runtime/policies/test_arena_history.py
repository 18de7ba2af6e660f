from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from runtime.core.types import Observation
from runtime.policies.arena.frame_history import History
from tests.runtime.policies.peers import FRANKA, seen

STEPS = (23, 16, 8, 0)
BLANK = seen(FRANKA)


def at(arrived: float, number: int) -> Observation:
    """An observation whose only picture is a number."""
    return replace(BLANK, arrived=arrived, pictures={"cam": np.full((1, 1, 3), number, np.uint8)})


def numbers(history: History, observation: Observation) -> list[int]:
    return [int(pictures["cam"][0, 0, 0]) for pictures in history.frames_before(observation)]


def test_at_the_steps_of_dreamzeros_clients_its_pictures_are_theirs() -> None:
    history = History(STEPS, 15.0)
    found = {}
    for frame in range(72):
        shown = at(100.0 + frame / 15.0, frame)
        history.add(shown)
        if frame in (23, 47, 71):
            found[frame] = numbers(history, shown)
    assert found == {23: [0, 7, 15, 23], 47: [24, 31, 39, 47], 71: [48, 55, 63, 71]}


def test_as_long_as_there_are_no_older_ones_the_oldest_is_repeated() -> None:
    history = History(STEPS, 15.0)
    for frame in range(5):
        history.add(at(frame / 15.0, frame))
    assert numbers(history, at(5 / 15.0, 5)) == [0, 0, 0, 5]


def test_after_it_was_forgotten_only_what_came_since_is_shown() -> None:
    history = History(STEPS, 15.0)
    history.add(at(1.0, 1))
    history.reset()
    assert numbers(history, at(2.0, 2)) == [2, 2, 2, 2]


def test_what_was_seen_after_the_moment_that_is_asked_about_is_not_shown() -> None:
    history = History((8, 0), 15.0)
    for frame in range(18):
        history.add(at(frame / 15.0, frame))
    assert numbers(history, at(10 / 15.0, 99)) == [2, 99]


@given(st.lists(st.floats(0.01, 0.5), min_size=1, max_size=80))
def test_the_last_is_the_request_own_order_is_kept_and_memory_is_bounded(gaps: list[float]) -> None:
    history, now = History(STEPS, 15.0), 0.0
    for number, gap in enumerate(gaps):
        now += gap
        found = numbers(history, at(now, number))
        assert found == sorted(found)
        assert found[-1] == number
    assert len(history._kept) <= (23 + 8) / 15.0 / min(gaps) + 2
