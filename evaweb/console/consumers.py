"""The live socket of a page on a station.

Watching needs the database once, when the socket opens. Renewing a lease and stopping never do: they have
threads of their own, and go straight to the runtime. Beside them the login is looked at every few seconds: who has
logged out, or is no operator any more, keeps no lease.
"""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Coroutine
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any
from urllib.parse import parse_qs
from uuid import UUID

from channels.db import database_sync_to_async
from channels.generic.websocket import AsyncWebsocketConsumer
from django.db import Error

from evaweb.console import requests
from evaweb.console.aims import Aims
from evaweb.console.hub import Room, hub
from evaweb.console.logins import role_now
from evaweb.console.mailbox import Mailbox
from evaweb.console.requests import Aim, BadRequest, Credit, EStop, Events, Renew, Request, Stop, Watch
from evaweb.errors import NotFound, StationGone
from evaweb.roles import Role, role_of
from evaweb.sight import Sight, sight_of
from evaweb.stations import commands, leases, stops
from evaweb.stations.looks import facts_of
from evaweb.stations.models import Station
from evaweb.stations.selectors import station_get

log = logging.getLogger(__name__)
# Codes of a closed socket, after those of HTTP. After NEW_ROLE a page may come again at once.
BAD_REQUEST, NO_LOGIN, NEW_ROLE, NO_STATION = 4400, 4401, 4403, 4404
_MOST_ERRORS = 20
_LOGIN_S = 5.0  # how often the login is looked at
# Each waits for a station that may hang, and none of them may keep the others waiting; an e-stop least of all.
_renewals = ThreadPoolExecutor(32, "renew")
_stops = ThreadPoolExecutor(32, "stop")
_presses = ThreadPoolExecutor(32, "e-stop")
_under_way: set[asyncio.Task[None]] = set()  # they go on when the page is closed


class StationConsumer(AsyncWebsocketConsumer):
    """One page at one station."""

    # Nothing goes through the channel layer: live pages outlast the loss of Redis.
    channel_layer_alias = ""

    def __init__(self) -> None:
        super().__init__()
        self._outbox: asyncio.Queue[str | bytes] = asyncio.Queue()
        self._tasks: list[asyncio.Task[None]] = []
        self._room: Room | None = None
        self._mailbox: Mailbox | None = None
        self._aims: Aims | None = None
        self._renewing = False
        self._errors = 0

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Serve the page until it is gone, however that comes about."""
        try:
            await super().__call__(scope, receive, send)
        finally:
            for task in self._tasks:
                task.cancel()
            self._leave()

    async def dispatch(self, message: dict[str, Any]) -> None:
        """Channels would first close old connections to the database, in a thread that may be waiting for it."""
        if message["type"] == "websocket.receive":
            await self.websocket_receive(message)
        else:
            await super().dispatch(message)

    async def connect(self) -> None:
        """Accept, and close again with a code where the page has no business here: a browser sees no other."""
        await self.accept()
        self._user = self.scope["user"]
        self._page = parse_qs(self.scope["query_string"].decode()).get("page", [""])[-1]
        if not self._user.is_authenticated:
            await self.close(NO_LOGIN, "log in first")
        elif not requests.PAGE.fullmatch(self._page):
            await self.close(BAD_REQUEST, "page = 1 to 64 letters, digits, - or _")
        else:
            await self._admit(self.scope["url_route"]["kwargs"]["name"])

    async def _admit(self, name: str) -> None:
        try:
            station, role, facts, sight = await _in_database(_facts_of, name, self._user)
        except NotFound as error:
            await self.close(NO_STATION, str(error)[:120])
            return
        self._station, self._cameras = station, facts["cameras"]
        self._username = self._user.get_username()
        hello = {"station": station.name, "user": self._username, "role": role, "page": self._page}
        self._say({"type": "hello", **hello, "facts": facts})
        room = self._room = hub().room(station.name, station.robot)
        self._aims = Aims(station, self._username, role, self._say, lambda: room.looks)
        self._mailbox = room.join(self._outbox.put_nowait, self._user, sight)
        self._tasks = [asyncio.create_task(work) for work in (self._write(), self._follow_login(role))]
        for task in self._tasks:
            task.add_done_callback(_finished)

    def _leave(self) -> None:
        """Show nothing more, and hear nothing."""
        if self._room is not None and self._mailbox is not None:
            self._room.leave(self._mailbox)
        self._mailbox = None

    async def _follow_login(self, role: Role) -> None:
        """Close the socket when the user is logged out or has another role; a database that is away changes nothing."""
        now: Role | None = role
        while now is role:
            await asyncio.sleep(_LOGIN_S)
            try:
                now = await _in_database(role_now, self.scope["session"].session_key)
            except Error as error:
                log.warning("the database does not say who is logged in: %s", error)
        self._leave()
        if now is None:
            await self.close(NO_LOGIN, "log in again")
        else:
            await self.close(NEW_ROLE, f"you are {now} now")

    async def receive(self, text_data: str | None = None, bytes_data: bytes | None = None) -> None:
        """One message of the page."""
        if self._mailbox is None:
            return
        self._mailbox.heard()
        try:
            request = requests.parse(text_data or "", self._cameras)
        except BadRequest as error:
            await self._complain(str(error))
        else:
            self._do(request)

    def _do(self, request: Request) -> None:
        assert self._room is not None
        assert self._mailbox is not None
        assert self._aims is not None
        if isinstance(request, EStop):
            _go_on(self._press(request))
        elif isinstance(request, Stop):
            _go_on(self._stop(request))
        elif isinstance(request, Renew):
            if not self._renewing:  # else the one before has no answer yet
                self._renewing = True
                _go_on(self._renew(request))
        elif isinstance(request, Watch):
            self._room.watch(self._mailbox, request.streams)
        elif isinstance(request, Credit):
            self._mailbox.credit()
            self._room.ring()
        elif isinstance(request, Events):
            self._mailbox.want_events(request.after, request.boot)
            self._room.ring()
        elif isinstance(request, Aim) and self._aims.ask(request):
            _go_on(self._aims.answer())

    async def _press(self, request: EStop) -> None:
        """Press and say what came of it; then write it down."""
        name, why, uuid = self._station.name, request.why, request.uuid
        press = partial(stops.estop, station=name, username=self._username, why=why, uuid=uuid)
        answer = await asyncio.get_running_loop().run_in_executor(_presses, press)
        self._acknowledge("estop", uuid, answer)
        note = partial(commands.estop_noted, why=why, uuid=uuid, answer=answer)
        await _in_database(note, user=self._user, station=self._station)

    async def _stop(self, request: Stop) -> None:
        """Stop or halt and say what came of it; then write it down."""
        given = {"kind": request.kind, "page": self._page, "epoch": request.epoch, "uuid": request.uuid}
        stop = partial(stops.stop, station=self._station.name, username=self._username, **given)
        answer = await asyncio.get_running_loop().run_in_executor(_stops, stop)
        self._acknowledge(request.kind, request.uuid, answer)
        note = partial(commands.stop_noted, answer=answer, **given)
        await _in_database(note, user=self._user, station=self._station)

    def _acknowledge(self, kind: str, uuid: UUID, answer: stops.Answer) -> None:
        said = {"kind": kind, "uuid": str(uuid), "status": answer.status.value, "reason": answer.reason}
        self._say({"type": "ack", **said})

    async def _renew(self, request: Renew) -> None:
        """Pass the page's sign of life on; `lost`: the runtime says that the lease has ended."""
        renew = partial(
            leases.renew,
            username=self._username,
            page=self._page,
            station=self._station.name,
            epoch=request.epoch,
        )
        try:
            ack = await asyncio.get_running_loop().run_in_executor(_renewals, renew)
            refused = ack.status == "refused"
            self._say({"type": "renewed", "ok": not refused, "lost": refused, "reason": ack.reason})
        except StationGone as gone:
            self._say({"type": "renewed", "ok": False, "lost": False, "reason": str(gone)})
        finally:
            self._renewing = False

    async def _complain(self, reason: str) -> None:
        self._errors += 1
        if self._errors > _MOST_ERRORS:
            await self.close(BAD_REQUEST, "too many requests that mean nothing")
        else:
            self._say({"type": "error", "reason": reason})

    def _say(self, message: dict[str, Any]) -> None:
        self._outbox.put_nowait(json.dumps(message, separators=(",", ":")))

    async def _write(self) -> None:
        """Send what is in the outbox, in order."""
        while True:
            message = await self._outbox.get()
            if isinstance(message, str):
                await self.send(text_data=message)
            else:
                await self.send(bytes_data=message)


def _facts_of(name: str, user: Any) -> tuple[Station, Role, dict[str, Any], Sight]:
    station = station_get(name=name)
    return station, role_of(user), facts_of(station.robot), sight_of(user)


async def _in_database(work: Any, *arguments: Any, **named: Any) -> Any:
    """In a thread of its own: one that waits for the database must not keep others from it."""
    return await database_sync_to_async(work, thread_sensitive=False)(*arguments, **named)


def _go_on(work: Coroutine[Any, Any, None]) -> None:
    """Do it beside what the page says next, to its end."""
    task = asyncio.create_task(work)
    _under_way.add(task)
    task.add_done_callback(_finished)


def _finished(task: asyncio.Task[None]) -> None:
    _under_way.discard(task)
    if not task.cancelled() and task.exception() is not None:
        log.error("what was done for a page failed", exc_info=task.exception())
