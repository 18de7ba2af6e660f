"""HTTP requests take turns."""

from __future__ import annotations

import asyncio
import threading

import pytest
from asgiref.sync import ThreadSensitiveContext, sync_to_async

from evaweb.core import lock_wait
from evaweb.serving import request_limiter
from evaweb.serving.request_limiter import RequestLimiter
from tests.processes import PATIENCE_S


class Application:
    """Ends its requests when the test says so, and keeps how many are worked on and how long they may wait."""

    def __init__(self):
        self.at_once, self.most, self.hurries, self.may_end = 0, 0, [], asyncio.Event()

    async def __call__(self, scope, receive, send):
        self.at_once += 1
        self.most = max(self.most, self.at_once)
        self.hurries.append(lock_wait._hurry.get())
        if scope["path"] != "/healthz":
            await self.may_end.wait()
        self.at_once -= 1
        await send({"type": "http.response.start", "status": 200})


def asked(path="/", method="GET"):
    return {"type": "http", "method": method, "path": path, "headers": []}


def a_request():
    """What daphne tells of a request: its body, and once it hangs up that it did."""
    return queue_of({"type": "http.request", "body": b"", "more_body": False}).get


def queue_of(*messages):
    found = asyncio.Queue()
    for message in messages:
        found.put_nowait(message)
    return found


GONE = {"type": "http.disconnect"}


def statuses(sent):
    return [message["status"] for message in sent if "status" in message]


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr(request_limiter, "_AT_ONCE", 2)
    monkeypatch.setattr(request_limiter, "_MOST_WAITING", 3)


@pytest.mark.usefixtures("few")
def test_so_many_are_worked_on_so_many_wait_and_the_others_are_told():
    async def scenario():
        application, sent = Application(), []
        turns = RequestLimiter(application)

        async def send(message):
            sent.append(message)

        tasks = [asyncio.create_task(turns(asked(), a_request(), send)) for _ in range(9)]
        await turn_of_the_loop(lambda: len(statuses(sent)) == 4)
        assert statuses(sent) == [503] * 4
        await turns(asked("/healthz"), None, send)
        assert statuses(sent)[4:] == [200]
        application.may_end.set()
        await asyncio.gather(*tasks)
        assert statuses(sent)[5:] == [200] * 5
        assert application.most == 3  # with the one that asked how we are

    asyncio.run(scenario())


def test_nobody_has_more_than_a_share_of_the_turns():
    async def scenario():
        application, sent = Application(), []
        turns = RequestLimiter(application)

        async def send(message):
            sent.append(message)

        def of(login):
            return {**asked(), "headers": [(b"authorization", login)]}

        def begin(login, count):
            return [asyncio.create_task(turns(of(login), a_request(), send)) for _ in range(count)]

        tasks = begin(b"greedy", request_limiter._OF_ONE + request_limiter._WAITING_OF_ONE + 5)
        await turn_of_the_loop(lambda: len(statuses(sent)) == 5)
        assert (application.at_once, statuses(sent)) == (request_limiter._OF_ONE, [503] * 5)
        tasks += begin(b"another", 2)
        await turn_of_the_loop(lambda: application.at_once == request_limiter._OF_ONE + 2)
        for number in range(40):  # made up, of the same address
            tasks += begin(b"%d" % number, 1)
        await turn_of_the_loop(lambda: application.at_once == request_limiter._OF_ADDRESS)
        elsewhere = {**of(b"bob"), "client": ("10.0.0.7", 4000)}
        tasks.append(asyncio.create_task(turns(elsewhere, a_request(), send)))
        await turn_of_the_loop(lambda: application.at_once == request_limiter._OF_ADDRESS + 1)
        application.may_end.set()
        await asyncio.gather(*tasks)
        assert set(statuses(sent)[5:]) == {200}
        assert not turns._people.asking
        assert not turns._addresses.asking

    asyncio.run(scenario())


@pytest.mark.parametrize(
    "export",
    [
        {"path": "/result/failures.csv"},
        {"query_string": b"limit=1&format=csv"},
        {"query_string": b"format=Parquet"},
    ],
)
def test_few_exports_are_made_at_once_and_pages_do_not_wait_for_them(export):
    async def scenario():
        application, sent = Application(), []
        turns = RequestLimiter(application)

        async def send(message):
            sent.append(message)

        def begin(count, **scope):
            return [asyncio.create_task(turns({**asked(), **scope}, a_request(), send)) for _ in range(count)]

        tasks = begin(4, **export)
        await turn_of_the_loop(lambda: application.at_once == request_limiter._EXPORTS)
        tasks += begin(3)
        await turn_of_the_loop(lambda: application.at_once == request_limiter._EXPORTS + 3)
        application.may_end.set()
        await asyncio.gather(*tasks)
        assert statuses(sent) == [200] * 7

    asyncio.run(scenario())


@pytest.mark.usefixtures("few")
def test_one_that_hangs_up_while_it_waits_gives_its_place_back():
    async def scenario():
        application = Application()
        turns = RequestLimiter(application)
        clients = [queue_of() for _ in range(5)]
        tasks = [asyncio.create_task(turns(asked(), client.get, _nowhere)) for client in clients]
        await turn_of_the_loop(lambda: application.at_once == 2)
        for client in clients:
            client.put_nowait(GONE)
        await turn_of_the_loop(lambda: len(turns._tasks) == 2)
        application.may_end.set()
        await asyncio.gather(*tasks, return_exceptions=True)
        await asyncio.gather(*(turns(asked(), a_request(), _nowhere) for _ in range(5)))
        assert (application.most, len(application.hurries)) == (2, 7)

    asyncio.run(scenario())


@pytest.mark.usefixtures("few")
def test_a_turn_lasts_as_long_as_its_thread_whoever_hangs_up():
    """As daphne does it: it says that the client is gone, and ends what waits for the answer."""

    async def scenario():
        free, begun = threading.Event(), []

        def view(scope, receive, send):
            begun.append(scope)
            assert free.wait(PATIENCE_S)

        async def application(scope, receive, send):
            async with ThreadSensitiveContext():
                await django_like(sync_to_async(view)(scope, receive, send), receive)

        turns = RequestLimiter(application)
        for _ in range(4):
            client = queue_of({"type": "http.request"})
            task = asyncio.create_task(turns(asked(), client.get, _nowhere))
            await turn_of_the_loop(client.empty)
            client.put_nowait(GONE)
            await turn_of_the_loop(client.empty)
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        await turn_of_the_loop(lambda: len(begun) > 1)
        assert len(begun) == 2
        free.set()
        await turns(asked(), a_request(), _nowhere)
        assert len(begun) == 3

    asyncio.run(scenario())


async def django_like(work, receive):
    """Work that its handler leaves when the client hangs up."""
    await receive()
    found, gone = asyncio.ensure_future(work), asyncio.ensure_future(receive())
    await asyncio.wait((found, gone), return_when=asyncio.FIRST_COMPLETED)
    for one in (found, gone):
        one.cancel()
    await asyncio.gather(found, gone, return_exceptions=True)


async def turn_of_the_loop(check):
    deadline = asyncio.get_running_loop().time() + PATIENCE_S
    while not check():
        assert asyncio.get_running_loop().time() < deadline
        await asyncio.sleep(0.001)
    for _ in range(20):
        await asyncio.sleep(0)


def test_nothing_more_is_made_for_who_has_hung_up():
    async def scenario():
        client, made = queue_of({"type": "http.request"}), []

        async def application(scope, receive, send):
            await receive()
            for number in range(5):
                made.append(number)
                await send({"type": "http.response.body", "more_body": True})
                if number == 1:
                    client.put_nowait(GONE)
                    await turn_of_the_loop(client.empty)

        with pytest.raises(asyncio.CancelledError):
            await RequestLimiter(application)(asked(), client.get, _nowhere)
        assert made == [0, 1, 2]

    asyncio.run(scenario())


async def _nowhere(message):
    pass


def test_what_commands_does_not_wait_long_for_the_database():
    async def scenario():
        application = Application()
        application.may_end.set()
        turns = RequestLimiter(application)
        for scope in (
            asked("/api/v1/stations/b/lease", "POST"),
            asked("/api/v1/stations/b"),
            asked("/x", "POST"),
        ):
            await turns(scope, a_request(), _nowhere)
        assert application.hurries == [lock_wait.HURRY_S, None, None]

    asyncio.run(scenario())
