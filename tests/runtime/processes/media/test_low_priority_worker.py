"""What may be late gives way: the newest observation alone, at a lower priority, and no failure is kept quiet."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from types import MappingProxyType

import numpy as np
import pytest
import zmq

from runtime.core.types import Observation
from runtime.processes.media.low_priority_worker import NICE, LowPriorityWorker
from tests.processes import PATIENCE_S, eventually, joined


def numbered(sequence: int) -> Observation:
    return Observation(
        sequence=sequence,
        arrived=0.0,
        captured=MappingProxyType({}),
        qpos=np.zeros(1, np.float32),
        pictures=MappingProxyType({}),
    )


class Wanted:
    """Work that is wanted or not; `news` ends the sleep of who would do it."""

    def __init__(self, work: Callable[[Observation], None], wanted: bool = True) -> None:
        self._work, self._wants = work, wanted
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.socket, self._tells = self.context.socket(zmq.PAIR), self.context.socket(zmq.PAIR)
        self.socket.bind("inproc://news")
        self._tells.connect("inproc://news")

    def is_requested(self) -> bool:
        while self.socket.get(zmq.EVENTS) & zmq.POLLIN:
            self._wants = self.socket.recv() == b"yes"
        return self._wants

    def __call__(self, observation: Observation) -> None:
        self._work(observation)

    def say(self, word: bytes) -> None:
        self._tells.send(word)


@pytest.fixture
def wanting() -> Iterator[Callable[..., Wanted]]:
    made: list[Wanted] = []

    def make(work: Callable[[Observation], None], wanted: bool = True) -> Wanted:
        made.append(Wanted(work, wanted))
        return made[-1]

    yield make
    for one in made:
        one.context.destroy(linger=0)


def test_what_comes_while_it_is_at_work_is_passed_over_but_for_the_newest(
    wanting: Callable[..., Wanted],
) -> None:
    seen: list[int] = []
    begun, go_on = threading.Event(), threading.Event()

    def work(observation: Observation) -> None:
        seen.append(observation.sequence)
        begun.set()
        assert go_on.wait(PATIENCE_S)

    aside = LowPriorityWorker(wanting(work))
    aside(numbered(1))
    assert begun.wait(PATIENCE_S)
    for sequence in (2, 3, 4):
        aside(numbered(sequence))
    go_on.set()
    eventually(lambda: seen == [1, 4], "the newest is worked on")
    aside.close()
    assert seen == [1, 4]


def test_its_thread_gives_way_and_its_process_does_not(wanting: Callable[..., Wanted]) -> None:
    found: list[int] = []
    own = os.getpriority(os.PRIO_PROCESS, 0)

    def work(observation: Observation) -> None:
        found.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))

    aside = LowPriorityWorker(wanting(work))
    aside(numbered(1))
    eventually(lambda: bool(found), "it is worked on")
    aside.close()
    assert found == [min(19, own + NICE)]
    assert os.getpriority(os.PRIO_PROCESS, 0) == own


def test_a_failure_is_that_of_the_next_call(wanting: Callable[..., Wanted]) -> None:
    def work(observation: Observation) -> None:
        raise ValueError("no such picture")

    aside = LowPriorityWorker(wanting(work))
    aside(numbered(1))
    joined(aside._thread)
    with pytest.raises(ValueError, match="no such picture"):
        aside(numbered(2))
    aside.close()


def test_what_nobody_wants_is_not_done_and_who_begins_to_want_it_gets_the_newest_at_once(
    wanting: Callable[..., Wanted],
) -> None:
    seen: list[int] = []
    work = wanting(lambda observation: seen.append(observation.sequence), False)
    aside = LowPriorityWorker(work)
    eventually(lambda: not aside._wanted, "it has found that nobody wants it")
    aside(numbered(1))
    aside(numbered(2))
    work.say(b"yes")
    eventually(lambda: seen == [2], "the newest is worked on without another one")
    work.say(b"no")
    eventually(lambda: not aside._wanted, "it has found that nobody wants it")
    aside(numbered(3))
    aside.close()
    assert seen == [2]
