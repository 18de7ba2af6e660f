from __future__ import annotations

import threading

import pytest

from runtime.policies.watchdog import Watchdog
from tests.processes import PATIENCE_S, joined

SOON = 0.02
LONG = 60.0


class Watched:
    """A watchdog and what it did."""

    def __init__(self) -> None:
        self.cut = threading.Event()
        self.cuts = 0
        self.name = f"watched {id(self)}"  # that of the test before may be at its end yet
        self.dog = Watchdog(self.name, self._count)

    def threads(self) -> list[threading.Thread]:
        return [thread for thread in threading.enumerate() if thread.name == self.name]

    def _count(self) -> None:
        self.cuts += 1
        self.cut.set()


@pytest.fixture
def watched() -> Watched:
    return Watched()


def test_what_takes_too_long_is_cut_once_and_knows_it(watched: Watched) -> None:
    with watched.dog.deadline(SOON) as was_cut:
        assert watched.cut.wait(PATIENCE_S)
    assert was_cut()
    assert watched.cuts == 1


def test_what_is_done_in_time_is_never_cut_and_the_next_one_is_after_its_own_time(watched: Watched) -> None:
    with watched.dog.deadline(LONG) as was_cut:
        assert not was_cut()
    with watched.dog.deadline(SOON) as was_cut:
        assert watched.cut.wait(PATIENCE_S), "it slept on until the first deadline"
    assert watched.cuts == 1


def test_a_deadline_that_was_kept_does_not_cut_what_comes_after_it(watched: Watched) -> None:
    with watched.dog.deadline(SOON):
        pass
    with watched.dog.deadline(LONG) as was_cut:
        assert not watched.cut.wait(5 * SOON)
        assert not was_cut()


def test_a_later_one_does_not_take_an_earlier_cut_for_its_own(watched: Watched) -> None:
    with watched.dog.deadline(SOON):
        assert watched.cut.wait(PATIENCE_S)
    with watched.dog.deadline(LONG) as was_cut:
        assert not was_cut()


def test_it_is_one_thread_for_all_and_none_after_the_end(watched: Watched) -> None:
    for _ in range(5):
        with watched.dog.deadline(LONG):
            assert len(watched.threads()) == 1
    thread = watched.threads()[0]
    watched.dog.stop()
    joined(thread)
    assert not watched.threads()
    assert watched.cuts == 0


def test_it_watches_again_after_its_end(watched: Watched) -> None:
    with watched.dog.deadline(LONG):
        watched.dog.stop()
    with watched.dog.deadline(SOON) as was_cut:
        assert watched.cut.wait(PATIENCE_S)
        assert was_cut()
    watched.dog.stop()


@pytest.fixture(autouse=True)
def _end(watched: Watched) -> object:
    yield
    watched.dog.stop()
