from __future__ import annotations

import threading
import weakref

import pytest

from runtime.errors import PolicyError
from runtime.runner import LockstepRunner, ThreadRunner


def test_lockstep_hands_every_result_over_the_same_number_of_ticks_later() -> None:
    runner = LockstepRunner(2)
    first = runner.submit(lambda: 1)
    runner.tick()
    second = runner.submit(lambda: 2)
    ready = []
    for _ in range(3):
        ready.append((runner.ready(first), runner.ready(second)))
        runner.tick()
    assert ready == [(False, False), (True, False), (True, True)]
    assert first.result() + second.result() == 3


def test_lockstep_keeps_no_result_that_nobody_waits_for() -> None:
    runner = LockstepRunner(5)
    kept = weakref.ref(runner.submit(lambda: 1))
    assert kept() is None


def test_a_thread_of_its_own_makes_one_call_after_the_other() -> None:
    runner = ThreadRunner()
    gate, order = threading.Event(), []

    def slow() -> str:
        gate.wait(10)
        order.append("slow")
        return threading.current_thread().name

    first = runner.submit(slow)
    second = runner.submit(lambda: order.append("quick"))
    assert not runner.ready(first)
    assert not runner.ready(second)
    gate.set()
    second.result(10)
    assert first.result(10) != threading.current_thread().name
    assert order == ["slow", "quick"]
    assert runner.ready(first)
    runner.close()


def test_an_error_in_the_thread_is_told_as_a_policy_error() -> None:
    runner = ThreadRunner()
    future = runner.submit(lambda: 1 // 0)
    with pytest.raises(PolicyError, match="ZeroDivisionError"):
        future.result(10)
    runner.close()


def test_what_is_made_aside_waits_for_no_call_to_the_policy_and_makes_none_wait() -> None:
    runner = ThreadRunner()
    gate = threading.Event()
    first = runner.submit(lambda: gate.wait(10))
    assert runner.aside(lambda: 7).result(10) == 7
    gate.set()
    assert first.result(10)
    never = threading.Event()
    runner.aside(never.wait)
    assert runner.submit(lambda: 8).result(10) == 8
    assert not runner.busy
    never.set()
    runner.close()


def test_an_error_aside_is_its_own() -> None:
    for runner in (ThreadRunner(), LockstepRunner(0)):
        with pytest.raises(ZeroDivisionError):
            runner.aside(lambda: 1 // 0).result(10)
        runner.close()
