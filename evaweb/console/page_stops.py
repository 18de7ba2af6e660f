"""Stops and e-stops requested by a page, executed at once if the page's user is known.

If the user is not known yet, the credentials are looked up first. An e-stop is executed even if the database cannot be
asked; a stop is not. Once the user is known, nothing here waits for the database. The number of presses is not limited.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Sequence
from concurrent.futures import Future
from datetime import datetime
from functools import partial
from typing import Any
from uuid import UUID

from django.utils import timezone

from evaweb.accounts import login_audit
from evaweb.accounts.credentials import (
    UNVERIFIED,
    Credential,
    Login,
    LookupOverload,
    Unverifiable,
    credentials,
)
from evaweb.accounts.roles import Role
from evaweb.console.requests import EStop, Stop
from evaweb.core.errors import reasoned
from evaweb.stations import commands, stops
from evaweb.stations.models import CommandStatus, Station

_MOST_UNANSWERED = 200  # per page; stops beyond it are executed, but not acknowledged individually
SendCallback = Callable[[dict[str, Any]], None]
BackgroundCallback = Callable[
    [Coroutine[Any, Any, None]], None
]  # runs to its end, also when the page is closed


class PageStops:
    """Stops of one page at a station; for the event loop only. Set `login` when the user is known.

    `found` are the page's credentials, and `share` identifies its client for the limit of lookups.
    """

    def __init__(
        self,
        station: str,
        page: str,
        found: Sequence[Credential],
        share: str,
        say: SendCallback,
        go_on: BackgroundCallback,
    ) -> None:
        self.login: Login | None = None
        self._station, self._page, self._found, self._share = station, page, found, share
        self._say, self._go_on = say, go_on
        self._unanswered = 0

    def handle(self, request: EStop | Stop) -> None:
        """Execute the request; the page is sent the outcome when it is known."""
        at = timezone.now()
        if self.login is None:
            self._go_on(
                self._press_of(request, at) if isinstance(request, EStop) else self._stop_of(request, at)
            )
        elif isinstance(request, EStop):
            self._press(request, self.login, at)
        else:
            self._stop(request, self.login, at)

    async def _press_of(self, request: EStop, at: datetime) -> None:
        try:
            login = await credentials.resolve_presser(self._found, self._share)
        except (Unverifiable, LookupOverload) as fault:  # overload must not refuse an e-stop
            login_audit.estop_unverified(self._station, fault)
            self._press(request, None, at, str(fault))
        else:
            if login is not None:
                self._press(request, login, at)

    async def _stop_of(self, request: Stop, at: datetime) -> None:
        try:
            stopper = await credentials.resolve_stopper(self._found, self._share)
        except (Unverifiable, LookupOverload) as fault:
            unknown = stops.Answer(CommandStatus.FAILED, stops.UNKNOWN_STOPPER(why=fault))
            self._acknowledge(request.kind, request.uuid, unknown)
        else:
            if stopper is not None:
                self._stop(request, stopper[1], at)

    def _press(self, request: EStop, login: Login | None, at: datetime, unverified: str = "") -> None:
        reason, uuid = request.why, request.uuid
        username = login.username if login else UNVERIFIED
        answer = stops.press_estop(station=self._station, username=username, why=reason, uuid=uuid)
        user = login.account if login else None
        note = partial(commands.record_estop, user=user, why=reason, uuid=uuid, at=at, unverified=unverified)
        self._answer("estop", uuid, answer, note)

    def _stop(self, request: Stop, login: Login, at: datetime) -> None:
        """Execute a stop; if the user is a viewer, it is refused and not recorded."""
        if login.role is Role.VIEWER:
            refused = stops.Answer(CommandStatus.REFUSED, stops.refused_to_a_viewer(login.username))
            self._acknowledge(request.kind, request.uuid, refused)
            return
        fields = {"kind": request.kind, "page": self._page, "epoch": request.epoch, "uuid": request.uuid}
        answer = stops.request_stop(stops.stop_command(username=login.username, **fields), self._station)
        self._answer(
            request.kind,
            request.uuid,
            answer,
            partial(commands.record_stop, user=login.account, at=at, **fields),
        )

    def _answer(
        self, kind: str, uuid: UUID, answer: Future[stops.Answer], note: Callable[..., object]
    ) -> None:
        if self._unanswered < _MOST_UNANSWERED:
            self._unanswered += 1
            self._go_on(self._answered(kind, uuid, answer, note))

    async def _answered(
        self, kind: str, uuid: UUID, answer: Future[stops.Answer], note: Callable[..., object]
    ) -> None:
        try:
            result = await asyncio.wrap_future(answer)
        finally:
            self._unanswered -= 1
        self._acknowledge(kind, uuid, result)
        note(station=Station(name=self._station), answer=result)

    def _acknowledge(self, kind: str, uuid: UUID, answer: stops.Answer) -> None:
        fields = {"kind": kind, "uuid": str(uuid), "status": answer.status.value}
        self._say({"type": "ack", **fields, **reasoned(answer.reason)})
