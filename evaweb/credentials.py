"""Users of sessions and tokens: asked of the database, remembered for when it does not answer.

What is remembered never expires by itself: stopping works with it as long as this process lives. It is forgotten when
the database says otherwise, which is asked again whenever it is used and older than a few seconds. One that is not
remembered is asked about in the share of its origin: a crowd of made-up ones keeps no other client waiting.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from types import SimpleNamespace
from typing import Any

from django.conf import settings
from django.contrib.auth import get_user, get_user_model
from django.contrib.auth.signals import user_logged_out
from django.contrib.sessions.models import Session
from django.db import connection

from evaweb.lock_wait import short_lock_wait
from evaweb.lookups import FairLookupPool, LookupQueueFull
from evaweb.rarely import LogThrottle
from evaweb.roles import Role, role_of
from runtime.core.sentences import Pattern

log = logging.getLogger(__name__)
_faults = LogThrottle(10.0, 8)
SESSION, TOKEN = "session", "token"
EXPIRED_ALLOWED = {
    kind: f"{kind} of any age" for kind in (SESSION, TOKEN)
}  # also where its time is over: for an e-stop
UNVERIFIED = "unverified"  # the name of who presses while the database does not say who they are
_MOST = 4096  # remembered, and as many that are nobody's
_THREADS = 4  # for whoever is not remembered
_THREADS_OF_REMEMBERED = 2
_FRESH_S = 5.0  # for which an answer of the database is taken without asking again
COUNTS_S = 60.0  # for which it counts for what is no stop and needs no row, where the database says nothing
_PATIENCE_S = 0.5  # without any answer of the database, after which it is as good as gone
_TURN_S = 1.0  # for which who is not remembered waits for a turn, as long as the database answers others
_RECHECK_S = 0.25  # for which a stop of somebody who is remembered waits for it; an e-stop never does
RETRY_AFTER_S = 1
Credential = tuple[str, str]  # its kind, and the secret
_Key = tuple[str, str]  # a kind, and the digest of a secret


_AWAY = Pattern("credentials.database_away", "the database does not answer: {why}")
_LATE = Pattern("credentials.database_late", "the database did not answer within {seconds:g} s")
_NO_TURN = Pattern("credentials.no_turn", "the database has not come to this login within {seconds:g} s")


class Unverifiable(Exception):
    """The database did not say whose credential this is."""


class LookupOverload(Exception):
    """The database answers, and there are so many to ask about from one address that this one had no turn."""


@dataclass(frozen=True, slots=True)
class Login:
    """A user as the database last had them; `checked` is on this process's monotonic clock [s]."""

    pk: int
    username: str
    role: Role
    checked: float = field(compare=False)

    @property
    def account(self) -> Any:
        """As rows refer to it, without asking the database."""
        return get_user_model()(pk=self.pk, username=self.username)


_Said = Login | Unverifiable | LookupOverload | None


class CredentialCache:
    """Logins that this process has verified; from any thread. `wait` is asyncio's; a test has its own."""

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[..., Awaitable[object]] = asyncio.wait,
    ) -> None:
        self._clock, self._wait = clock, wait
        self._lock = threading.RLock()  # one that gives way to another is told while that one is asked about
        self._known: OrderedDict[_Key, Login] = OrderedDict()
        self._nobodys: OrderedDict[_Key, float] = OrderedDict()  # until when that is believed
        self._answered_at = -float("inf")
        self._asked: dict[tuple[_Key, str | None], Future[Login | None]] = {}
        self._strangers: FairLookupPool[Login | None] = FairLookupPool(_THREADS)
        self._remembered: FairLookupPool[Login | None] = FairLookupPool(_THREADS_OF_REMEMBERED, most=_MOST)
        self._owners: dict[str, Callable[[str], Any]] = {
            SESSION: session_user,
            EXPIRED_ALLOWED[SESSION]: ended_session_user,
        }

    def register_kind(self, kind: str, owner: Callable[[str], Any]) -> None:
        """Register how the user of a credential of that kind is looked up, None where there is none."""
        self._owners[kind] = owner

    def look_up(self, kind: str, secret: str) -> Any:
        """The user as the database has them now, None where there is none; in the caller's thread. Raises its Error."""
        with connection.execute_wrapper(self._heard):
            user = self._owners[kind](secret)
        if user is None:
            if kind in EXPIRED_ALLOWED and self.recall(kind, secret) is not None:
                self.look_up(EXPIRED_ALLOWED[kind], secret)  # whose time is over presses as before: at once
            self._is_nobodys((kind, digest(secret)))
        else:
            self.remember(kind, secret, user)
        return user

    def record_answer(self) -> None:
        """The database has just answered something."""
        self._answered_at = self._clock()

    def _heard(self, execute: Callable[..., Any], *asked: Any) -> Any:
        answer = execute(*asked)
        self.record_answer()
        return answer

    def _is_nobodys(self, key: _Key) -> None:
        self.forget(*key)
        with self._lock:
            self._nobodys[key] = self._clock() + _FRESH_S
            self._nobodys.move_to_end(key)
            while len(self._nobodys) > _MOST:
                self._nobodys.popitem(last=False)

    def remember(self, kind: str, secret: str, user: Any) -> None:
        """The database has just said that it is this user's."""
        login = Login(user.pk, user.get_username(), role_of(user), self._clock())
        key = (kind, digest(secret))
        with self._lock:
            self._nobodys.pop(key, None)
            self._known[key] = login
            self._known.move_to_end(key)
            while len(self._known) > _MOST:
                self._known.popitem(last=False)

    def recall(self, kind: str, secret: str) -> Login | None:
        """Login it stood for when the database was last asked; without asking."""
        with self._lock:
            return self._known.get((kind, digest(secret)))

    def recall_recent(self, kind: str, secret: str) -> Login | None:
        """Login it stands for as the database said within the last minute; without asking."""
        known = self.recall(kind, secret)
        return known if known is not None and self._clock() - known.checked < COUNTS_S else None

    def forget(self, kind: str, digested: str) -> None:
        """Drop a credential that stands for no user any more."""
        with self._lock:
            self._known.pop((kind, digested), None)

    async def resolve_presser(self, found: Sequence[Credential], share: str) -> Login | None:
        """The user of an e-stop, by any of these credentials: at once where one is remembered, else by the database.

        No press is lost for a date: a credential whose time is over is one here. None: the database says that they
        are unknown. Raises Unverifiable where it says nothing, Busy where `share` has no turn though it answers.
        """
        for kind, secret in found:
            for remembered in (kind, _of_any_age(kind)):
                known = self.recall(remembered, secret)
                if known is not None:
                    if not self._fresh(known):
                        self._check(remembered, secret)
                    return known
        asking = [
            asyncio.create_task(self._resolve_unknown(_of_any_age(kind), secret, share))
            for kind, secret in found
        ]
        try:
            return await _first_known(asking)
        finally:
            for one in asking:
                one.cancel()

    async def resolve_stopper(self, found: Sequence[Credential], share: str) -> tuple[str, Login] | None:
        """The user of a stop or halt, and the kind of credential: one that is remembered, else any other.

        As the database says, or as it said last where it does not answer. None: unknown. Raises Unverifiable, Busy.
        """
        fault: LookupOverload | None = None
        for kind, secret in sorted(found, key=lambda one: self.recall(*one) is None):
            known = self.recall(kind, secret)
            if known is None:
                login = await self._resolve_unknown(kind, secret, share)
            else:
                login = known if self._fresh(known) else await self._checked(kind, secret, known)
            if isinstance(login, Login):
                return kind, login
            if isinstance(login, Unverifiable):
                raise login
            fault = fault or login
        if fault is not None:
            raise fault
        return None

    def _fresh(self, known: Login) -> bool:
        return self._clock() - known.checked < _FRESH_S

    async def _checked(self, kind: str, secret: str, known: Login) -> Login | None:
        """The database's answer on a remembered login, or that login, where the database takes its time."""
        answer = asyncio.wrap_future(self._check(kind, secret))
        await self._wait({answer}, timeout=_RECHECK_S)
        if answer.done() and answer.exception() is None:
            return answer.result()
        answer.add_done_callback(_read)
        return known

    def _resolve_unknown(self, kind: str, secret: str, share: str) -> Coroutine[Any, Any, _Said]:
        """Whose credential it is that is not remembered, or why that is not known; asked about from now on."""
        if self._is_known_as_nobodys((kind, digest(secret))):
            return self._said_of(None)
        return self._said_of(self._check(kind, secret, share))

    async def _said_of(self, asked: Future[Login | None] | None) -> _Said:
        if asked is None:
            return None
        came = self._clock()
        answer = asyncio.wrap_future(asked)
        answer.add_done_callback(_read)
        try:
            while not asked.done():  # which the loop may not have noticed yet
                await self._wait({answer}, timeout=remaining_wait(came, self._answered_at, self._clock()))
        except (Unverifiable, LookupOverload) as fault:
            return fault
        failed = asked.exception()
        if isinstance(failed, LookupQueueFull):
            return LookupOverload(str(failed))
        return asked.result() if failed is None else Unverifiable(_AWAY(why=failed))

    def _is_known_as_nobodys(self, key: _Key) -> bool:
        with self._lock:
            return self._nobodys.get(key, -float("inf")) > self._clock()

    def _check(self, kind: str, secret: str, share: str | None = None) -> Future[Login | None]:
        """Ask the database, once for all callers with the same question; it does not wait.

        Without a `share`, who is remembered: those stand before nobody and behind nobody else.
        """
        key = ((kind, digest(secret)), share)
        with self._lock:
            asked = self._asked.get(key)
            if asked is not None:
                return asked
            work = partial(self._ask, kind, secret)
            lookups = self._remembered if share is None else self._strangers
            asked = self._asked[key] = lookups.submit(share, work)
        asked.add_done_callback(lambda _: self._done(key))
        return asked

    def _done(self, key: tuple[_Key, str | None]) -> None:
        with self._lock:
            self._asked.pop(key, None)

    def _ask(self, kind: str, secret: str) -> Login | None:
        """A credential of any age is one that is good now, or one whose time is over."""
        try:
            with short_lock_wait():
                for one in (*(now for now, ever in EXPIRED_ALLOWED.items() if ever == kind), kind):
                    if self.look_up(one, secret) is not None:
                        return self.recall(one, secret)
        except Exception as fault:  # whatever it is: the database has not said who this is
            before = _faults.suffix_if_due(kind)
            if before is not None:
                log.warning("a %s was not verified: %s%s", kind, fault, before)
            raise
        finally:
            connection.close()
        return None


def remaining_wait(came: float, answered: float, now: float) -> float:
    """Time that a caller since `came` still waits [s]; the database last answered at `answered` [s].

    Raises Unverifiable where it has answered no look-up for half a second, Busy where others were before it longer.
    """
    silent = max(came, answered) + _PATIENCE_S - now
    if silent <= 0:
        raise Unverifiable(_LATE(seconds=_PATIENCE_S))
    if came + _TURN_S <= now:
        raise LookupOverload(_NO_TURN(seconds=_TURN_S))
    return min(silent, came + _TURN_S - now)


async def _first_known(asking: Sequence[asyncio.Task[_Said]]) -> Login | None:
    """The first known user; raises Unverifiable at once, and Busy where nothing else is known."""
    busy: LookupOverload | None = None
    for one in asyncio.as_completed(asking):
        answer = await one
        if isinstance(answer, Login):
            return answer
        if isinstance(answer, Unverifiable):
            raise answer
        busy = busy or answer
    if busy is not None:
        raise busy
    return None


def _of_any_age(kind: str) -> str:
    return EXPIRED_ALLOWED.get(kind, kind)


def digest(secret: str) -> str:
    """Not salted and not slow: a secret of more than 128 random bits cannot be guessed."""
    return hashlib.sha256(secret.encode("utf-8", "surrogateescape")).hexdigest()


def session_user(session_key: str) -> Any:
    """The user of that session, as the database has them now; reads only."""
    if not (session_key.isascii() and session_key.isalnum()):  # one that some databases cannot even look for
        return None
    return _logged_in(import_module(settings.SESSION_ENGINE).SessionStore(session_key))


def ended_session_user(session_key: str) -> Any:
    """The same, whenever that session ends or has ended: not of one that was logged out, or lost its password."""
    if not (session_key.isascii() and session_key.isalnum()):
        return None
    row = Session.objects.filter(session_key=session_key).first()
    if row is None:
        return None
    session = import_module(settings.SESSION_ENGINE).SessionStore(session_key)
    session._session_cache = row.get_decoded()  # which is otherwise read only where it has not ended
    return _logged_in(session)


def _logged_in(session: Any) -> Any:
    asks: Any = SimpleNamespace(session=session)
    user = get_user(asks)
    return user if user.is_authenticated else None


def _read(answer: asyncio.Future[Login | None]) -> None:
    """No caller may wait for it any more: its error was logged where it arose."""
    if not answer.cancelled():
        answer.exception()


def _logged_out(request: Any = None, **named: Any) -> None:
    session = getattr(request, "session", None)
    if session is not None and session.session_key:
        for kind in (SESSION, EXPIRED_ALLOWED[SESSION]):
            credentials.forget(kind, digest(session.session_key))


credentials = CredentialCache()
user_logged_out.connect(_logged_out, dispatch_uid="evaweb.credentials")
