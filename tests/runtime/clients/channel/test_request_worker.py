import threading
import time
from queue import Queue

import pytest

from runtime.clients.channel import request_worker as module
from runtime.clients.channel.message import Message
from runtime.clients.channel.request_worker import Job, RequestWorker
from tests.processes import PATIENCE_S, joined


class Clerk:
    """Answers with the name of the message; "slow" waits to be let go, "bad" is a fault of ours."""

    def __init__(self):
        self.let_go, self.began, self.closed = threading.Event(), threading.Event(), False

    def answer(self, holder, message):
        if message.name == "slow":
            self.began.set()
            assert self.let_go.wait(PATIENCE_S)
        if message.name == "bad":
            raise ValueError("a mistake")
        return {"ok": True, "name": message.name, "holder": holder}

    def close(self):
        self.closed = True


class World:
    def __init__(self, keep=lambda: None):
        self.clerk, self.replies, self.stops = Clerk(), Queue(), 0
        self.lane = RequestWorker(
            "test", self.clerk, lambda to, answer: self.replies.put(answer), lambda: self.stops, keep
        )

    def put(self, name, form="cmd", came=None, stops=0, of=b"x"):
        message = Message(form, name, {"cmd": f"web:{name}"})
        came = time.monotonic() if came is None else came
        return self.lane.submit(Job([of, b""], "me", message, came, stops))

    def reply(self):
        return self.replies.get(timeout=PATIENCE_S)


@pytest.fixture
def world():
    made = World()
    yield made
    made.clerk.let_go.set()
    made.lane.end(PATIENCE_S)
    assert made.clerk.closed


def test_jobs_are_answered_in_their_order(world):
    for name in ("a", "b", "c"):
        assert world.put(name)
    assert [world.reply()["name"] for _ in range(3)] == ["a", "b", "c"]


def test_a_mistake_of_ours_is_an_answer_and_not_the_end(world, caplog):
    world.put("bad")
    assert world.reply() == {"ok": False, "error": "handler error: ValueError: a mistake", "cmd": "web:bad"}
    world.put("a")
    assert world.reply()["ok"]


def test_what_has_waited_too_long_is_not_carried_out_any_more(world):
    world.put("run", came=time.monotonic() - module.LATE_S - 1.0)
    answer = world.reply()
    assert (answer["ok"], answer["result"]) == (False, "refused")
    assert "behind others: not carried out" in answer["error"]


def test_what_waits_while_a_stop_comes_is_not_carried_out_after_it(world):
    world.put("slow")
    assert world.clerk.began.wait(PATIENCE_S)
    world.put("run")
    world.put("status", form="query")
    world.stops = 1
    world.put("start", stops=1)
    world.clerk.let_go.set()
    assert world.reply()["ok"]
    answer = world.reply()
    assert (answer["ok"], answer["error"]) == (False, "a stop came after it: not carried out")
    assert world.reply()["name"] == "status"
    assert world.reply()["name"] == "start"


def test_a_full_inbox_takes_no_more(world):
    world.put("slow")
    assert world.clerk.began.wait(PATIENCE_S)
    found = [world.put("a", of=b"%d" % number) for number in range(module.WAITING + 1)]
    assert found == [True] * module.WAITING + [False]


def test_one_connection_cannot_take_the_room_of_others(world):
    world.put("slow")
    assert world.clerk.began.wait(PATIENCE_S)
    assert [world.put("a") for _ in range(module.EACH + 1)] == [True] * module.EACH + [False]
    assert world.put("b", of=b"another")
    world.clerk.let_go.set()
    assert [world.reply()["name"] for _ in range(module.EACH + 2)][-1] == "b"
    assert [world.put("a") for _ in range(module.EACH)] == [True] * module.EACH


@pytest.mark.parametrize(("keep", "carried_out"), [(lambda: None, 1), (None, 4)])
def test_a_lane_that_ends_answers_what_it_is_about_and_stops_alone_to_the_last(keep, carried_out):
    world = World(keep)
    world.put("slow")
    assert world.clerk.began.wait(PATIENCE_S)
    for _ in range(3):
        world.put("a")
    ending = threading.Thread(target=world.lane.end, args=(PATIENCE_S,))
    ending.start()
    while not world.lane._over.is_set():
        time.sleep(0.001)
    world.clerk.let_go.set()
    joined(ending)
    assert world.clerk.closed
    assert world.replies.qsize() == carried_out


def test_what_is_due_is_done_with_messages_and_without_and_may_fail():
    kept = Queue()

    def keep():
        kept.put(1)
        raise ValueError("a mistake")

    world = World(keep)
    try:
        assert [kept.get(timeout=PATIENCE_S) for _ in range(3)] == [1, 1, 1]
        world.put("a")
        assert world.reply()["ok"]
    finally:
        world.lane.end(PATIENCE_S)


def test_a_lane_of_stops_carries_out_whatever_comes_however_late():
    world = World(None)
    try:
        world.stops = 5
        world.put("stop", came=time.monotonic() - 100.0)
        assert world.reply()["ok"]
    finally:
        world.lane.end(PATIENCE_S)
