from __future__ import annotations

import threading
import weakref

import pytest

from runtime.core.errors import PolicyError
from runtime.processes.coordinator.inference.runners import DeclaredRunner, LockstepRunner, ThreadRunner
from tests.processes import PATIENCE_S


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
        gate.wait(PATIENCE_S)
        order.append("slow")
        return threading.current_thread().name

    first = runner.submit(slow)
    second = runner.submit(lambda: order.append("quick"))
    assert not runner.ready(first)
    assert not runner.ready(second)
    gate.set()
    second.result(PATIENCE_S)
    assert first.result(PATIENCE_S) != threading.current_thread().name
    assert order == ["slow", "quick"]
    assert runner.ready(first)
    runner.close()


def test_an_error_in_the_thread_is_told_as_a_policy_error() -> None:
    runner = ThreadRunner()
    future = runner.submit(lambda: 1 // 0)
    with pytest.raises(PolicyError, match="ZeroDivisionError"):
        future.result(PATIENCE_S)
    runner.close()


def test_what_is_made_aside_waits_for_no_call_to_the_policy_and_makes_none_wait() -> None:
    runner = ThreadRunner()
    gate = threading.Event()
    first = runner.submit(lambda: gate.wait(PATIENCE_S))
    assert runner.run_in_background(lambda: 7).result(PATIENCE_S) == 7
    gate.set()
    assert first.result(PATIENCE_S)
    never = threading.Event()
    runner.run_in_background(never.wait)
    assert runner.submit(lambda: 8).result(PATIENCE_S) == 8
    assert not runner.busy
    never.set()
    runner.close()


def test_an_error_aside_is_its_own() -> None:
    for runner in (ThreadRunner(), LockstepRunner(0)):
        with pytest.raises(ZeroDivisionError):
            runner.run_in_background(lambda: 1 // 0).result(PATIENCE_S)
        runner.close()


def declaring(ticks: int) -> DeclaredRunner:
    """Hands over what was answered as a sentence, `ticks` late."""
    return DeclaredRunner(lambda answer: (f"{answer}", ticks))


def test_a_declared_delay_counts_from_the_question_whatever_the_call_took() -> None:
    runner = declaring(3)
    gate = threading.Event()
    future = runner.submit(lambda: gate.wait(PATIENCE_S))
    assert runner.busy
    assert runner.start_waiting()  # being made: no time may pass now
    gate.set()
    assert future.result(PATIENCE_S) == "True"
    ready = []
    for _ in range(5):
        ready.append(runner.ready(future))
        runner.tick()
    assert ready == [False, False, False, True, True]
    runner.close()


def test_what_is_declared_to_take_no_time_is_there_with_the_next_tick() -> None:
    runner = declaring(0)
    future = runner.submit(lambda: 1)
    runner.start_waiting()
    assert future.result(PATIENCE_S) == "1"
    assert not runner.ready(future)
    runner.tick()
    assert runner.ready(future)
    runner.close()


def test_no_call_is_made_before_time_stands_still() -> None:
    runner, made = declaring(1), []
    futures = [runner.submit(lambda number=number: made.append(number)) for number in range(3)]
    runner.tick()
    assert made == []
    runner.start_waiting()
    assert futures[-1].result(PATIENCE_S) == "None"
    assert made == [0, 1, 2]
    runner.close()


def test_an_error_of_a_call_or_of_what_it_declares_is_handed_over_with_the_next_tick() -> None:
    def declared(answer: object) -> tuple[object, int]:
        raise PolicyError("it says -1 ms")

    runner = DeclaredRunner(declared)
    failing, odd = runner.submit(lambda: 1 // 0), runner.submit(lambda: 1)
    runner.start_waiting()
    with pytest.raises(PolicyError, match="ZeroDivisionError"):
        failing.result(PATIENCE_S)
    with pytest.raises(PolicyError, match="it says -1 ms"):
        odd.result(PATIENCE_S)
    runner.tick()
    assert runner.ready(failing)
    assert runner.ready(odd)
    assert runner.run_in_background(lambda: 7).result() == 7
    runner.close()
