"""A page on a station without a browser: its live socket, through the whole application."""

from __future__ import annotations

import asyncio
import json

from channels.testing import WebsocketCommunicator
from django.conf import settings
from django.db import connections
from django.test import Client

from evaweb.asgi import application
from evaweb.console import hub as hubs
from evaweb.core.binary_frames import decode
from tests.processes import PATIENCE_S


class Page:
    """A browser's page on a station; draws every frame unless it is told not to."""

    def __init__(self, station, user, page="p1", origin=b"http://localhost", query=None):
        self._user = user
        self._headers = [(b"origin", origin), (b"host", b"localhost")]
        query = f"page={page}" if query is None else query
        self._path = f"/ws/stations/{station}?{query}"
        self.draws = True
        self.texts = []
        self.frames = []

    async def connected(self):
        if self._user.is_authenticated and len(self._headers) < 3:
            value = await asyncio.to_thread(cookie, self._user)
            self._headers.append((b"cookie", f"{settings.SESSION_COOKIE_NAME}={value}".encode()))
        self._socket = WebsocketCommunicator(application, self._path, self._headers)
        return (await self._socket.connect(timeout=PATIENCE_S))[0]

    async def open(self):
        assert await self.connected()
        return self

    async def refused(self):
        """The code with which the socket is closed right after it was opened."""
        assert await self.connected()
        return (await self._socket.receive_output(PATIENCE_S))["code"]

    async def say(self, **message):
        await self._socket.send_to(text_data=json.dumps(message))

    async def next(self, timeout=10):
        """The next message: a map, or a frame that was drawn."""
        message = await self._socket.receive_output(timeout)
        if message["type"] == "websocket.close":
            return message
        if message.get("text") is not None:
            self.texts.append(json.loads(message["text"]))
            return self.texts[-1]
        self.frames.append(decode(message["bytes"]))
        if self.draws:
            await self.say(type="credit")
        return self.frames[-1]

    async def told(self, kind, wanted=lambda text: True):
        """The next text of a kind that is as wanted."""
        while True:
            found = await self.next()
            if isinstance(found, dict) and found.get("type") == kind and wanted(found):
                return found

    async def shown(self, wanted):
        """The next frame with what is wanted of its streams."""
        while True:
            found = await self.next()
            if not isinstance(found, dict) and wanted(found.header["streams"]):
                return found

    async def silent(self):
        return await self._socket.receive_nothing(0.3)

    async def close(self):
        await self._socket.disconnect()


def cookie(user):
    """That of a session of this user's."""
    client = Client()
    client.force_login(user)
    connections.close_all()
    return client.cookies[settings.SESSION_COOKIE_NAME].value


def run(scenario):
    """Run it, and leave no room behind."""

    async def whole():
        try:
            await scenario
        finally:
            rooms = hubs.hub()._rooms.values()
            assert all(room.empty for room in rooms)

    asyncio.run(whole())
