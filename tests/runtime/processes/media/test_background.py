"""What may be late gives way: the newest observation alone, at a lower priority, and no failure is kept quiet."""

from __future__ import annotations

import os
import threading
from types import MappingProxyType

import numpy as np
import pytest

from runtime.core.types import Observation
from runtime.processes.media.background import NICE, LowPriorityWorker
from tests.processes import eventually


def numbered(sequence: int) -> Observation:
    return Observation(
        sequence=sequence,
        arrived=0.0,
        captured=MappingProxyType({}),
        qpos=np.zeros(1, np.float32),
        pictures=MappingProxyType({}),
    )


def test_what_comes_while_it_is_at_work_is_passed_over_but_for_the_newest() -> None:
    seen: list[int] = []
    begun, go_on = threading.Event(), threading.Event()

    def work(observation: Observation) -> None:
        seen.append(observation.sequence)
        begun.set()
        assert go_on.wait(30)

    aside = LowPriorityWorker(work)
    aside(numbered(1))
    assert begun.wait(30)
    for sequence in (2, 3, 4):
        aside(numbered(sequence))
    go_on.set()
    eventually(lambda: seen == [1, 4], 30, "the newest is worked on")
    aside.close()
    assert seen == [1, 4]


def test_its_thread_gives_way_and_its_process_does_not() -> None:
    found: list[int] = []
    own = os.getpriority(os.PRIO_PROCESS, 0)
    aside = LowPriorityWorker(
        lambda observation: found.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))
    )
    aside(numbered(1))
    eventually(lambda: bool(found), 30, "it is worked on")
    aside.close()
    assert found == [min(19, own + NICE)]
    assert os.getpriority(os.PRIO_PROCESS, 0) == own


def test_a_failure_is_that_of_the_next_call() -> None:
    def work(observation: Observation) -> None:
        raise ValueError("no such picture")

    aside = LowPriorityWorker(work)
    aside(numbered(1))
    aside._thread.join(30)
    with pytest.raises(ValueError, match="no such picture"):
        aside(numbered(2))
    aside.close()
