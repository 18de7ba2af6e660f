"""A station is heard once and encoded once, however many watch it."""

from __future__ import annotations

import asyncio

import pytest

from evaweb.blinding.visibility import FULL_VISIBILITY
from evaweb.console import hub as hubs


@pytest.mark.django_db(transaction=True)
def test_viewers_of_the_same_are_sent_the_very_same_bytes(live, ann):
    async def scenario():
        loop = asyncio.get_running_loop()
        room = hubs.LiveHub(loop).room(live.name, live.robot)
        got = [[], []]
        boxes = [room.join(sent.append, ann, FULL_VISIBILITY) for sent in got]
        for box in boxes:
            room.watch(box, ["state"])
        while not all(any(isinstance(message, bytes) for message in sent) for sent in got):
            await asyncio.sleep(0.01)
        first, second = (next(m for m in sent if isinstance(m, bytes)) for sent in got)
        assert first is second
        for box in boxes:
            room.leave(box)

    asyncio.run(scenario())
