"""Requests that are under way: a flood costs two, and no station waits for another."""

from __future__ import annotations

import threading

import pytest

from evaweb.stations import request_coalescer
from evaweb.stations.request_coalescer import RequestCoalescer, TooManyRequests
from tests.processes import PATIENCE_S


class Slow:
    """Work that is over when the test says so, and answers how often it was done."""

    def __init__(self):
        self.begun, self.may_end, self.times = threading.Semaphore(0), threading.Semaphore(0), 0

    def __call__(self):
        self.times += 1
        answer = self.times
        self.begun.release()
        assert self.may_end.acquire(timeout=PATIENCE_S)
        return answer


def test_a_flood_of_presses_is_answered_by_the_one_under_way_and_makes_one_more():
    all_of_them, slow = RequestCoalescer("press"), Slow()
    first = all_of_them.submit("dead", slow, identity=0, shared=True)
    assert slow.begun.acquire(timeout=PATIENCE_S)
    flood = [all_of_them.submit("dead", slow, identity=number, shared=True) for number in range(1, 1500)]
    slow.may_end.release()
    assert {answer.result(PATIENCE_S) for answer in (first, *flood)} == {1}
    assert slow.begun.acquire(timeout=PATIENCE_S), "one that came after the first was sent is not lost"
    slow.may_end.release()
    last = all_of_them.submit("dead", lambda: 3, identity="later", shared=True)
    assert last.result(PATIENCE_S) in (2, 3)
    assert slow.times == 2


def test_a_stop_that_came_after_one_was_sent_is_sent_and_answered_itself():
    all_of_them, slow = RequestCoalescer("stop"), Slow()
    first = all_of_them.submit("bench", slow, key="halt", identity="a")
    assert slow.begun.acquire(timeout=PATIENCE_S)
    again = all_of_them.submit("bench", slow, key="halt", identity="a")
    others = [all_of_them.submit("bench", slow, key="halt", identity=number) for number in range(100)]
    slow.may_end.release(2)
    assert (first.result(PATIENCE_S), again.result(PATIENCE_S)) == (1, 1)
    assert {answer.result(PATIENCE_S) for answer in others} == {2}


def test_a_dead_station_keeps_no_other_and_no_other_kind_waiting():
    all_of_them, slow = RequestCoalescer("press"), Slow()
    hangs = all_of_them.submit("dead", slow, identity=0)
    assert all_of_them.submit("alive", lambda: "pressed", identity=0).result(PATIENCE_S) == "pressed"
    assert all_of_them.submit("dead", lambda: "halted", key="halt", identity=0).result(PATIENCE_S) == "halted"
    assert not hangs.done()
    slow.may_end.release()
    assert hangs.result(PATIENCE_S) == 1


def test_one_station_has_so_many_under_way_and_another_its_own():
    all_of_them, slow = RequestCoalescer("stop", most=2), Slow()
    for key in "ab":
        all_of_them.submit("bench", slow, key=key, identity=0)
    with pytest.raises(TooManyRequests, match="2 requests to bench are under way"):
        all_of_them.submit("bench", slow, key="c", identity=0)
    other = all_of_them.submit("other", lambda: "done", identity=0)
    assert other.result(PATIENCE_S) == "done"
    slow.may_end.release(2)


def test_what_fails_is_everybodys_answer_and_the_next_is_done():
    all_of_them, slow = RequestCoalescer("stop"), Slow()

    def broken():
        slow()
        raise ValueError("broken")

    first = all_of_them.submit("bench", broken, identity="a")
    assert slow.begun.acquire(timeout=PATIENCE_S)
    second = all_of_them.submit("bench", lambda: "done", identity="b")
    first.cancel()
    slow.may_end.release()
    assert second.result(PATIENCE_S) == "done"
    with pytest.raises(ValueError, match="broken"):
        first.result(PATIENCE_S)


def test_without_a_thread_a_robot_is_stopped_all_the_same(monkeypatch):
    class NoThread:
        def __init__(self, **named):
            pass

        def start(self):
            raise RuntimeError("can't start new thread")

    monkeypatch.setattr(request_coalescer, "Thread", NoThread)
    assert RequestCoalescer("press").submit("bench", lambda: "pressed", identity=0).result(0) == "pressed"
