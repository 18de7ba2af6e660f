"""The demo waits as long as something goes on, and says what it waited for where nothing does."""

from __future__ import annotations

import threading

import pytest

from evaweb.lab import single_trial, stall_detection
from evaweb.lab.rest_client import LivePage, StateTimeout
from evaweb.lab.stall_detection import (
    STILL_S,
    DemoFailed,
    NoReply,
    wait_until,
)
from tests.standing import state_flags


class Clock:
    """Time that passes where one sleeps."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += 60.0


@pytest.fixture
def clock(monkeypatch):
    made = Clock()
    monkeypatch.setattr(stall_detection, "time", made)
    return made


def test_what_goes_on_is_waited_for_however_slow_it_is(clock):
    found = wait_until(lambda: int(clock.now // 120), lambda rows: rows == 50, "waiting for the dataset")
    assert found == 50
    assert clock.now > 30 * STILL_S


def test_what_stands_still_is_an_error_that_says_what_was_waited_for_and_how_it_stands(clock):
    with pytest.raises(DemoFailed, match=r"waiting for the dataset: no progress for 180 s; it is .*queued"):
        wait_until(lambda: {"job": "queued"}, lambda found: False, "waiting for the dataset")
    assert clock.now < 2 * STILL_S


def test_a_lab_that_does_not_reply_is_asked_again_and_not_for_ever(clock):
    replies = iter([NoReply("timed out"), NoReply("timed out"), "scored"])

    def ask():
        reply = next(replies)
        if isinstance(reply, NoReply):
            raise reply
        return reply

    assert wait_until(ask, bool, "scoring") == "scored"

    def mute():
        raise NoReply("http://127.0.0.1:1 does not answer: timed out")

    with pytest.raises(DemoFailed, match=r"scoring: no progress for 180 s; it is http://.* timed out"):
        wait_until(mute, bool, "scoring")


def test_a_refusal_is_told_at_once(clock):
    def refused():
        raise DemoFailed("HTTP 409: trial 1 is running")

    with pytest.raises(DemoFailed, match="trial 1 is running"):
        wait_until(refused, bool, "scoring")
    assert clock.now == 0.0


def station(clock: Clock, at="running", **said):
    state = {"boot": "b", "sequence": 3, **state_flags(at), "reason": "", "stages": [], "truth": {}}
    return state | {"clock": clock.now, "lease": {"epoch": 1}, "run": {"number": 1, "elapsed": 0.0}} | said


class Page(LivePage):
    """A page whose states are those of a function of the time."""

    def __init__(self, clock, says):
        self._clock, self._says = clock, says
        self.asked = []

    def wait(self, reached, seconds, what):
        self._clock.sleep(seconds)
        self._state = self._says()
        if reached(self._state):
            return self._state
        raise StateTimeout(what)

    def command(self, kind, trial=None):
        self.asked.append(kind)


def test_a_run_on_a_slow_machine_is_watched_to_its_end_by_its_own_clock(clock):
    def says():
        elapsed = clock.now / 100
        state = "running" if elapsed < 40 else "ready"
        return station(clock, state, run={"number": 1, "elapsed": elapsed})

    assert single_trial.run_to_its_end(Page(clock, says), 1, 40.0, lockstep=True) == 0
    assert clock.now > 4000


@pytest.mark.parametrize(
    ("elapsed", "fault"),
    [
        (lambda clock: 7.0, r"running: no progress for 180 s; it is running: "),
        (lambda clock: clock.now, r"the run goes on beyond its 40 s: "),
    ],
)
def test_a_run_that_stands_still_or_never_ends_is_an_error(clock, elapsed, fault):
    page = Page(clock, lambda: station(clock, run={"number": 1, "elapsed": elapsed(clock)}))
    with pytest.raises(DemoFailed, match=fault):
        single_trial.run_to_its_end(page, 1, 40.0)


def test_that_the_clock_of_the_station_goes_on_is_no_progress_of_a_set_up(clock):
    stages = [{"name": "connect", "state": "active", "seconds": 0.0}]
    page = Page(clock, lambda: station(clock, "setting_up", stages=stages))
    with pytest.raises(DemoFailed, match="setting up: no progress for 180 s; it is setting_up"):
        single_trial.set_up_and_run(page, 1)
    assert page.asked == ["setup"]


def test_a_publication_that_has_failed_is_told_with_its_error(clock):
    class Visitor:
        def get(self, path):
            failed = {"key": "publish:u", "status": "failed", "error": "disk full"}
            return (
                {"items": [failed]} if path.startswith("jobs") else {"dataset_index": None, "duration_s": 1.0}
            )

    with pytest.raises(DemoFailed, match="waiting for the dataset: job publish:u has failed: disk full"):
        single_trial._published(Visitor(), "u")


def test_an_answer_about_an_earlier_lease_ends_no_later_one(clock):
    page = Page(clock, dict)
    page.epoch, page._failure, page._changed = 2, "", threading.Condition()
    page._on_message({"type": "renewed", "ok": False, "lost": True, "reason": "claim it first", "epoch": 1})
    assert page._failure == ""
    page._on_message({"type": "renewed", "ok": False, "lost": True, "reason": "claim it first", "epoch": 2})
    assert page._failure == "the lease was lost: claim it first"
