"""Live socket of a page at a station.

Watching needs the database once, when the socket opens. Renewing a lease and stopping never need the database: they
have their own threads and go directly to the runtime, and stops are obeyed even before the database has named the user.
In parallel the login is checked every few seconds: a user who has logged out, or is no longer an operator, loses the
lease.
"""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Collection, Coroutine
from functools import partial
from typing import Any
from urllib.parse import parse_qs

from channels.db import database_sync_to_async
from channels.generic.websocket import AsyncWebsocketConsumer
from django.db import Error

from evaweb.accounts.client_addresses import client_key
from evaweb.accounts.cookies import session_keys
from evaweb.accounts.credentials import (
    COUNTS_S,
    SESSION,
    Login,
    credentials,
)
from evaweb.accounts.roles import Role, role_of
from evaweb.blinding.visibility import FULL_VISIBILITY, Visibility, visibility_for_user
from evaweb.console import requests
from evaweb.console.aim_queries import AimQueries
from evaweb.console.flow_control import PER_SECOND, MessageQuota
from evaweb.console.hub import StationRoom, hub
from evaweb.console.mailbox import Mailbox
from evaweb.console.page_stops import PageStops
from evaweb.console.requests import Aim, BadRequest, Credit, EStop, Events, Renew, Request, Stop, Watch
from evaweb.console.viewers import current_role
from evaweb.core.errors import NotFound, StationGone, reasoned
from evaweb.stations import leases
from evaweb.stations.models import Station
from evaweb.stations.request_coalescer import RequestCoalescer, TooManyRequests
from evaweb.stations.robot_geometry import describe_robot
from evaweb.stations.selectors import station_get
from runtime.core.sentences import Pattern, identity
from runtime.ipc.messages import Ack

log = logging.getLogger(__name__)
# Close codes of the socket, modelled on HTTP status codes. After NEW_ROLE a page may reconnect at once.
BAD_REQUEST, NO_LOGIN, NEW_ROLE, NO_STATION, TOO_MUCH = 4400, 4401, 4403, 4404, 4429
_MOST_ERRORS = 20
_MOST_EARLY = 50  # messages queued until the database has named the user
_LOGIN_S = 5.0  # period of checking the login
_AGAIN_S = 1.0  # retry delay after a failed query
_renewals: RequestCoalescer[Ack] = RequestCoalescer(
    "renew", most=32
)  # limited per station, because a station may hang
_LOGIN_UNKNOWN = Pattern(
    "console.login_unknown",
    "login unknown: the database has not answered for {seconds:.0f} s; stopping works",
)
_NOT_SAID = _LOGIN_UNKNOWN(seconds=COUNTS_S)
_under_way: set[asyncio.Task[None]] = set()  # tasks that continue after the page is closed


class StationConsumer(AsyncWebsocketConsumer):
    """Live socket of one page at one station."""

    # No channel layer, so that live pages survive the loss of Redis.
    channel_layer_alias = ""

    def __init__(self) -> None:
        super().__init__()
        self._outbox: asyncio.Queue[str | bytes] = asyncio.Queue()
        self._tasks: list[asyncio.Task[None]] = []
        self._room: StationRoom | None = None
        self._mailbox: Mailbox | None = None
        self._aims: AimQueries | None = None
        self._renewing = self._admitted = False
        self._errors = 0
        self._sessions: list[str] = []  # session keys of the request's cookies; at most one is the login's
        self._session = ""  # session key of the login; empty if the page was rejected
        self._cameras: Collection[str] = ()
        self._early: list[str] = []
        self._quota, self._over = MessageQuota(), False

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Serve the page until its socket is closed, then cancel its tasks and leave the room."""
        try:
            await super().__call__(scope, receive, send)
        finally:
            for task in self._tasks:
                task.cancel()
            self._leave()

    async def dispatch(self, message: dict[str, Any]) -> None:
        """Dispatch a message to its handler.

        Unlike Channels' own method it does not close old database connections first: their thread may be waiting for
        the database.
        """
        if message["type"] == "websocket.receive":
            await self.websocket_receive(message)
            await asyncio.sleep(0)  # lets other connections run if this one floods
        else:
            await super().dispatch(message)

    async def connect(self) -> None:
        """Accept the socket, and close it with a code if the page is not allowed.

        It is accepted first because browsers report only codes that are sent after accepting.
        """
        await self.accept()
        cookies = (value.decode("latin-1") for name, value in self.scope["headers"] if name == b"cookie")
        self._sessions = session_keys(cookies)
        self._page = parse_qs(self.scope["query_string"].decode()).get("page", [""])[-1]
        self._station = self.scope["url_route"]["kwargs"]["name"]
        if not self._sessions:
            await self.close(NO_LOGIN, "log in first")
        elif not requests.PAGE.fullmatch(self._page):
            await self.close(BAD_REQUEST, "page = 1 to 64 letters, digits, - or _")
        else:
            recalled = (key for key in self._sessions if credentials.recall(SESSION, key))
            self._session = next(recalled, self._sessions[0])
            candidates = [(SESSION, key) for key in self._sessions]
            self._stopping = PageStops(
                self._station, self._page, candidates, client_key(self.scope), self._send_text, _go_on
            )
            self._run_until_closed(self._write())
            self._run_until_closed(self._admit())

    async def _admit(self) -> None:
        """Query the user until the database answers, then admit or refuse the page; stops are obeyed meanwhile."""
        admitted = None
        while admitted is None:
            try:
                admitted = await _in_database(_admitted, self._station, self._sessions)
            except NotFound as error:
                await self._end(NO_STATION, _short(str(error)))
                return
            except Error as error:
                log.warning("the database does not say who has opened a page of %s: %s", self._station, error)
                await asyncio.sleep(_AGAIN_S)
        self._session, user, station, role, facts, visibility = admitted
        if not self._session:
            await self._end(NO_LOGIN, "log in first")
            return
        self._stopping.login, self._cameras = credentials.recall(SESSION, self._session), facts["cameras"]
        hello = {"station": station.name, "user": user.get_username(), "role": role, "page": self._page}
        self._send_text({"type": "hello", **hello, "facts": facts})
        room = self._room = hub().room(station.name, station.robot)
        self._aims = AimQueries(station, user.get_username(), role, self._send_text, lambda: room.drawn_robot)
        self._mailbox = room.join(self._outbox.put_nowait, user, visibility)
        self._run_until_closed(self._follow_login(role))
        self._admitted = True
        early, self._early = self._early, []
        for text in early:
            await self.receive(text)

    def _run_until_closed(self, work: Coroutine[Any, Any, None]) -> None:
        """Run a task until the page is closed."""
        self._tasks.append(asyncio.create_task(work))
        self._tasks[-1].add_done_callback(_finished)

    async def _end(self, code: int, reason: str) -> None:
        self._session = ""
        await self.close(code, reason)

    def _leave(self) -> None:
        """Leave the room: no more streams for this page."""
        if self._room is not None and self._mailbox is not None:
            self._room.leave(self._mailbox)
        self._mailbox = None

    async def _follow_login(self, role: Role) -> None:
        """Close the socket when the user is logged out or has another role; database failures are ignored."""
        now: Role | None = role
        while now is role:
            await asyncio.sleep(_LOGIN_S)
            try:
                now = await _in_database(current_role, self._session)
            except Error as error:
                log.warning("the database does not say who is logged in: %s", error)
        self._leave()
        if now is None:
            await self.close(NO_LOGIN, "log in again")
        else:
            await self.close(NEW_ROLE, f"you are {now.with_article} now")

    async def receive(self, text_data: str | None = None, bytes_data: bytes | None = None) -> None:
        """Parse one message of the page and carry out its request.

        Messages without a login are ignored. Stops are always carried out. Any other message beyond the page's quota
        closes the socket. Messages that arrive before the database has named the user are queued, except renewals of a
        lease by a recently known user.
        """
        text = text_data or _decode_binary(bytes_data or b"")
        if not self._session or (self._over and not requests.may_be_stop(text)):
            return
        within, request = self._quota.take(), self._parsed(text)
        if isinstance(request, EStop | Stop):
            self._stopping.handle(request)
        elif not within:
            await self._close_flooded()
        elif self._mailbox is not None:
            self._mailbox.mark_read()
            await self._handle(request)
        elif isinstance(request, Renew) and not self._admitted and self._counted is not None:
            self._renew_lease(request)  # the page was reloaded while the database is unavailable
        elif len(self._early) < _MOST_EARLY:
            self._early.append(text)

    @property
    def _counted(self) -> Login | None:
        return credentials.recall_recent(SESSION, self._session)

    def _parsed(self, text: str) -> Request | BadRequest:
        try:
            return requests.parse(text, self._cameras)
        except BadRequest as error:
            return error

    async def _close_flooded(self) -> None:
        """Report the flood once and close the socket; stops are obeyed until it is closed."""
        if not self._over:
            self._over = True
            self._leave()
            reason = f"more than {PER_SECOND:.0f} messages a second"
            await self.send(text_data=_as_text({"type": "error", "reason": reason}))
            await self.close(TOO_MUCH, reason)

    async def _handle(self, request: Request | BadRequest) -> None:
        assert self._room is not None
        assert self._mailbox is not None
        assert self._aims is not None
        if isinstance(request, BadRequest):
            await self._send_error(str(request))
        elif isinstance(request, Renew):
            self._renew_lease(request)
        elif isinstance(request, Watch):
            self._room.watch(self._mailbox, request.streams)
        elif isinstance(request, Credit):
            self._mailbox.credit()
            self._room.schedule_flush()
        elif isinstance(request, Events):
            self._mailbox.want_events(request.after, request.boot)
            self._room.schedule_flush()
        elif isinstance(request, Aim) and self._counted is None:
            refusal = {"ok": False, "reason": _NOT_SAID, "sentence": identity(_NOT_SAID)}
            self._send_text({"type": "aimed", "id": request.id, **refusal})
        elif isinstance(request, Aim) and self._aims.submit(request):
            _go_on(self._aims.answer())

    def _renew_lease(self, request: Renew) -> None:
        """Renew the lease if the database has confirmed the user within the last minute, even if it is
        unavailable now.
        """
        login = self._counted
        if login is None:
            self._send_text({"type": "renewed", "ok": False, "lost": False, **reasoned(_NOT_SAID)})
        elif not self._renewing:  # else the previous renewal is still unanswered
            self._renewing = True
            _go_on(self._renew(request, login.username))

    async def _renew(self, request: Renew, username: str) -> None:
        """Forward the page's heartbeat to the runtime; `lost` in the answer means that the lease has ended."""
        renew = partial(
            leases.renew,
            username=username,
            page=self._page,
            station=self._station,
            epoch=request.epoch,
            hidden=request.hidden,
        )
        try:
            key, identity = (username, self._page), (request.epoch, request.hidden)
            ack = await asyncio.wrap_future(
                _renewals.submit(self._station, renew, key=key, identity=identity)
            )
            refused = ack.status == "refused"
            self._send_text(
                {
                    "type": "renewed",
                    "ok": not refused,
                    "lost": refused,
                    **reasoned(ack.reason),
                    "epoch": request.epoch,
                }
            )
        except (StationGone, TooManyRequests) as gone:
            self._send_text({"type": "renewed", "ok": False, "lost": False, **reasoned(str(gone))})
        finally:
            self._renewing = False

    async def _send_error(self, reason: str) -> None:
        self._errors += 1
        if self._errors > _MOST_ERRORS:
            await self.close(BAD_REQUEST, "too many requests that mean nothing")
        else:
            self._send_text({"type": "error", "reason": reason})

    def _send_text(self, message: dict[str, Any]) -> None:
        self._outbox.put_nowait(_as_text(message))

    async def _write(self) -> None:
        """Send the messages of the outbox in order."""
        while True:
            message = await self._outbox.get()
            if isinstance(message, str):
                await self.send(text_data=message)
            else:
                await self.send(bytes_data=message)


class UnknownAddressConsumer(AsyncWebsocketConsumer):
    """Consumer for unknown addresses of live sockets."""

    channel_layer_alias = ""

    async def connect(self) -> None:
        """Accept the connection, and close it at once with code NO_STATION."""
        await self.accept()
        await self.close(NO_STATION, "there is nothing at this address")


def _short(reason: str) -> str:
    """Return `reason` truncated to the 123 bytes that a close frame may carry."""
    return reason.encode("utf-8", "replace")[:123].decode("utf-8", "ignore")


_Admitted = tuple[str, Any, Station | None, Role, dict[str, Any], Visibility]


def _admitted(name: str, sessions: list[str]) -> _Admitted:
    """Return data for the first session that has a user: session, user, station, role, robot description, visibility.

    If no session has a user, the session is "" and nothing may be shown.

    Raises:
        NotFound: If the station does not exist.
    """
    for session in sessions:
        user = credentials.look_up(SESSION, session)
        if user is not None:
            station = station_get(name=name)
            return (
                session,
                user,
                station,
                role_of(user),
                describe_robot(station.robot),
                visibility_for_user(user),
            )
    return "", None, None, Role.VIEWER, {}, FULL_VISIBILITY


def _decode_binary(message: bytes) -> str:
    """Return the text of a binary message.

    Our pages send no binary messages, but one from another client may be an e-stop press.
    """
    return message.decode(json.detect_encoding(message), "replace")


def _as_text(message: dict[str, Any]) -> str:
    return json.dumps(message, separators=(",", ":"))


async def _in_database(work: Any, *arguments: Any, **named: Any) -> Any:
    """Run `work` in a thread of its own and return its result, so that a slow query does not block others."""
    return await database_sync_to_async(work, thread_sensitive=False)(*arguments, **named)


def _go_on(work: Coroutine[Any, Any, None]) -> None:
    """Start a task that runs to its end in parallel to further messages, even if the page is closed."""
    task = asyncio.create_task(work)
    _under_way.add(task)
    task.add_done_callback(_finished)


def _finished(task: asyncio.Task[None]) -> None:
    _under_way.discard(task)
    if not task.cancelled() and task.exception() is not None:
        log.error("what was done for a page failed", exc_info=task.exception())
