"""The queue before an encoder, driven by a simulated clock: rows come at 30 Hz, the encoder is as slow as told."""

import threading
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.recording.encoder_queue import (
    RUN,
    Pace,
    Picture,
    PictureQueue,
    encode_count,
)
from tests.examples import some

from .samples import numbered

FPS = 30.0
MAX_LAG_S = 0.5
PICTURE = np.zeros((2, 2, 3), np.uint8)


class Simulated:
    """Rows at `FPS`, and one encoder that needs `cost(time)` seconds per coded frame."""

    def __init__(self, cost: Callable[[float], float], places: int = 8) -> None:
        self._cost = cost
        self._queue = PictureQueue(places, MAX_LAG_S)
        self._free = 0.0  # when the encoder has done what it is at
        self._put: list[float] = []
        self._done = 0
        self.taken: list[bool] = []
        self.lags: list[float] = []  # of each row, from its coming until its frame was coded

    def run(self, rows: int) -> float:
        """Let so many rows come, then drain; how long draining takes [s]."""
        for row in range(rows):
            now = row / FPS
            self._work(now)
            self._put.append(now)
            self.taken.append(self._queue.put(PICTURE))
            self._free = max(self._free, now) if self._queue.waiting() == 1 else self._free
        ended = rows / FPS
        self._work(float("inf"))
        assert self._done == rows
        return max(0.0, self._free - ended)

    def _work(self, until: float) -> None:
        while self._free <= until and self._queue.waiting():
            entry = self._queue.get()
            frames = 1 if isinstance(entry, Picture) else entry
            coded = 1 if isinstance(entry, Picture) else encode_count(frames)
            took = coded * self._cost(self._free)
            self._free += took
            self._queue.report_encoded(coded, took)
            for _ in range(frames):
                self.lags.append(self._free - self._put[self._done])
                self._done += 1


@pytest.mark.parametrize("cost", [0.0, 0.001, 0.02, 0.033])
def test_an_encoder_that_keeps_up_loses_no_picture(cost: float) -> None:
    run = Simulated(lambda time: cost)
    run.run(900)
    assert all(run.taken)


@settings(max_examples=some(60))
@given(cost=st.floats(0.0, 1.5), places=st.integers(1, 64))
def test_it_is_never_further_behind_than_the_bound_and_a_few_frames(cost: float, places: int) -> None:
    run = Simulated(lambda time: cost, places)
    drained = run.run(600)
    # A run in the encoder's hands, what the bound admits but at least one picture, and a run behind it.
    bound = 3 * cost + max(MAX_LAG_S, cost) + 3 * cost
    assert max(run.lags[150:]) <= bound + 1e-9
    assert drained <= bound + 1e-9
    assert max(run.lags) <= max(bound, (17 + 6) * cost) + 1e-9  # before the pace is known it is guessed


@settings(max_examples=some(60))
@given(
    costs=st.lists(st.floats(0.0, 0.4), min_size=1, max_size=20),
    seconds=st.lists(st.floats(0.05, 3.0), min_size=1, max_size=20),
)
def test_it_recovers_from_any_change_of_pace(costs: list[float], seconds: list[float]) -> None:
    spans = np.cumsum(seconds)

    def cost(time: float) -> float:
        place = int(np.searchsorted(spans, time % spans[-1]))
        return costs[place % len(costs)]

    run = Simulated(cost, places=8)
    run.run(600)
    worst = max(costs)
    assert max(run.lags) <= MAX_LAG_S + (8 + 6) * worst + 1e-9


def test_once_it_is_fast_again_every_picture_is_taken() -> None:
    run = Simulated(lambda time: 0.3 if 2.0 < time < 6.0 else 0.004)
    run.run(600)
    assert all(run.taken[:60])
    assert not all(run.taken[60:180])
    assert all(run.taken[210:])
    assert max(run.lags[210:]) < 0.01


def test_a_slow_encoder_still_gets_as_many_pictures_as_it_can_code() -> None:
    run = Simulated(lambda time: 0.1)
    run.run(900)
    assert sum(run.taken) >= 60  # of 300 that fit into 30 s, beside the repeats between them


def test_the_queue_holds_a_bounded_number_of_pictures_and_counts_repeats() -> None:
    queue = PictureQueue(places=2)
    taken = [queue.put(numbered(k)) for k in range(5)]
    assert taken == [True, True, False, False, False]
    assert queue.put(None) is False
    assert queue.waiting() == 6
    queue.close()
    entries = [queue.get() for _ in range(4)]
    assert [entry if isinstance(entry, int) else "picture" for entry in entries[:3]] == [
        "picture",
        "picture",
        4,
    ]
    assert entries[3] is None


def test_a_place_is_free_again_once_a_picture_was_taken() -> None:
    queue = PictureQueue(places=1)
    assert queue.put(numbered(0))
    assert not queue.put(numbered(1))
    queue.get()
    assert queue.put(numbered(2))


def test_what_would_wait_too_long_is_not_taken_and_an_empty_queue_takes_anything() -> None:
    queue = PictureQueue(places=8, max_lag_s=0.5)
    queue.report_encoded(1, 0.2)
    assert [queue.put(PICTURE) for _ in range(4)] == [True, True, False, False]
    for _ in range(3):
        queue.get()
    queue.report_encoded(1, 60.0)
    assert queue.put(PICTURE)
    assert not queue.put(PICTURE)


def test_a_patient_caller_waits_for_a_place_however_slow_the_encoder_is() -> None:
    queue = PictureQueue(places=2, max_lag_s=0.5)
    queue.report_encoded(1, 60.0)
    assert queue.put(numbered(0), patience=60.0)
    assert queue.put(numbered(1), patience=60.0)
    taker = threading.Thread(target=queue.get)
    taker.start()
    assert queue.put(numbered(2), patience=60.0)
    taker.join()


@given(st.integers(1, 100_000))
def test_a_run_of_repeats_is_coded_in_three_frames_at_most(repeats: int) -> None:
    assert encode_count(repeats) <= min(repeats, 3)
    assert repeats < RUN or (repeats - encode_count(repeats)) % 2 == 0


def test_the_pace_is_slower_at_once_and_faster_after_a_while() -> None:
    pace = Pace()
    pace.update(2, 0.4)
    assert pace.coding_s == pytest.approx(0.2)
    pace.update(1, 0.5)
    assert pace.coding_s == pytest.approx(0.5)
    pace.update(1, 0.0)
    assert pace.coding_s == pytest.approx(0.4)
