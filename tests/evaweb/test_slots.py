"""HTTP requests take turns."""

from __future__ import annotations

import asyncio

import pytest

from evaweb import lock_wait, slots
from evaweb.slots import Slots


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
    return {"type": "http", "method": method, "path": path}


def statuses(sent):
    return [message["status"] for message in sent if "status" in message]


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr(slots, "_AT_ONCE", 2)
    monkeypatch.setattr(slots, "_MOST_WAITING", 3)


@pytest.mark.usefixtures("few")
def test_so_many_are_worked_on_so_many_wait_and_the_others_are_told():
    async def scenario():
        application, sent = Application(), []
        turns = Slots(application)

        async def send(message):
            sent.append(message)

        tasks = [asyncio.create_task(turns(asked(), None, send)) for _ in range(9)]
        while len(statuses(sent)) < 4:
            await asyncio.sleep(0)
        assert statuses(sent) == [503] * 4
        await turns(asked("/healthz"), None, send)
        assert statuses(sent)[4:] == [200]
        application.may_end.set()
        await asyncio.gather(*tasks)
        assert statuses(sent)[5:] == [200] * 5
        assert application.most == 3  # with the one that asked how we are

    asyncio.run(scenario())


@pytest.mark.usefixtures("few")
def test_one_that_goes_away_while_it_waits_gives_its_place_back():
    async def scenario():
        application = Application()
        turns = Slots(application)
        tasks = [asyncio.create_task(turns(asked(), None, _nowhere)) for _ in range(5)]
        while application.at_once < 2:
            await asyncio.sleep(0)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        application.may_end.set()
        await asyncio.gather(*(turns(asked(), None, _nowhere) for _ in range(5)))
        assert turns._waiting == 0

    asyncio.run(scenario())


async def _nowhere(message):
    pass


def test_what_commands_does_not_wait_long_for_the_database():
    async def scenario():
        application = Application()
        application.may_end.set()
        turns = Slots(application)
        for scope in (
            asked("/api/v1/stations/b/lease", "POST"),
            asked("/api/v1/stations/b"),
            asked("/x", "POST"),
        ):
            await turns(scope, None, _nowhere)
        assert application.hurries == [lock_wait.HURRY_S, None, None]

    asyncio.run(scenario())
