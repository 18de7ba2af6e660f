"""Users of sessions and tokens, looked up in the database and cached, so that stops work even if it does not respond.

A cached login never expires: a stop with it works as long as this process lives. The login is removed from the cache
when the database contradicts it; whenever a cached login is used and older than a few seconds, the database is asked
again. Lookups of unknown credentials are queued by client, and clients take turns: a flood of invented credentials from
one client does not delay the others.
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

from evaweb.accounts.lookup_pool import FairLookupPool, LookupQueueFull
from evaweb.accounts.roles import Role, role_of
from evaweb.core.lock_wait import short_lock_wait
from evaweb.core.log_throttle import LogThrottle
from runtime.core.sentences import Pattern

log = logging.getLogger(__name__)
_faults = LogThrottle(10.0, 8)
SESSION, TOKEN = "session", "token"
EXPIRED_ALLOWED = {
    kind: f"{kind} of any age" for kind in (SESSION, TOKEN)
}  # expired credentials are accepted for an e-stop
UNVERIFIED = "unverified"  # user name of an e-stop while the database does not respond
_MOST = 4096  # cached logins, and as many credentials known to be invalid
_THREADS = 4  # for lookups of uncached credentials
_THREADS_OF_REMEMBERED = 2
_FRESH_S = 5.0  # validity of a database answer before it is asked again
COUNTS_S = 60.0  # its validity for requests other than stops that need no row, while the database is silent
_PATIENCE_S = 0.5  # silence after which the database counts as gone
_TURN_S = 1.0  # longest wait of an uncached credential for its turn while the database answers others
_RECHECK_S = 0.25  # longest wait of a stop with a cached login for the database; an e-stop does not wait
RETRY_AFTER_S = 1
Credential = tuple[str, str]  # its kind, and the secret
_Key = tuple[str, str]  # a kind, and the digest of a secret


_AWAY = Pattern("credentials.database_away", "the database does not answer: {why}")
_LATE = Pattern("credentials.database_late", "the database did not answer within {seconds:g} s")
_NO_TURN = Pattern("credentials.no_turn", "login lookup: not served within {seconds:g} s; try again")


class Unverifiable(Exception):
    """Error if the database did not report the user of a credential."""


class LookupOverload(Exception):
    """Error if the database responds, but too many lookups from this address are queued."""


@dataclass(frozen=True, slots=True)
class Login:
    """User as the database last reported them.

    `checked` is the time of that report [s] on the monotonic clock of this process.
    """

    pk: int
    username: str
    role: Role
    checked: float = field(compare=False)

    @property
    def account(self) -> Any:
        """Unsaved model instance of the user, for foreign keys; needs no query."""
        return get_user_model()(pk=self.pk, username=self.username)


_Said = Login | Unverifiable | LookupOverload | None


class CredentialCache:
    """Logins that this process has verified; thread-safe. `wait` is asyncio.wait, replaced in tests."""

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[..., Awaitable[object]] = asyncio.wait,
    ) -> None:
        self._clock, self._wait = clock, wait
        self._lock = (
            threading.RLock()
        )  # reentrant: submitting a lookup can complete another one, whose callback takes the lock
        self._known: OrderedDict[_Key, Login] = OrderedDict()
        self._nobodys: OrderedDict[_Key, float] = OrderedDict()  # invalid credentials and when to ask again
        self._answered_at = -float("inf")
        self._asked: dict[tuple[_Key, str | None], Future[Login | None]] = {}
        self._strangers: FairLookupPool[Login | None] = FairLookupPool(_THREADS)
        self._remembered: FairLookupPool[Login | None] = FairLookupPool(_THREADS_OF_REMEMBERED, most=_MOST)
        self._owners: dict[str, Callable[[str], Any]] = {
            SESSION: session_user,
            EXPIRED_ALLOWED[SESSION]: ended_session_user,
        }

    def register_kind(self, kind: str, owner: Callable[[str], Any]) -> None:
        """Register the function `owner`, which looks up the user of a credential of `kind`.

        It returns None if there is no such user.
        """
        self._owners[kind] = owner

    def look_up(self, kind: str, secret: str) -> Any:
        """Return the user from the database, None if there is none, and update the cache.

        Runs in the caller's thread. Raises: the database's Error.
        """
        with connection.execute_wrapper(self._on_answer):
            user = self._owners[kind](secret)
        if user is None:
            if kind in EXPIRED_ALLOWED and self.recall(kind, secret) is not None:
                self.look_up(
                    EXPIRED_ALLOWED[kind], secret
                )  # cache the expired credential, so that an e-stop with it needs no lookup
            self._is_nobodys((kind, digest(secret)))
        else:
            self.remember(kind, secret, user)
        return user

    def record_answer(self) -> None:
        """Record that the database has just responded."""
        self._answered_at = self._clock()

    def _on_answer(self, execute: Callable[..., Any], *asked: Any) -> Any:
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
        """Cache the user that the database has just reported for this credential."""
        login = Login(user.pk, user.get_username(), role_of(user), self._clock())
        key = (kind, digest(secret))
        with self._lock:
            self._nobodys.pop(key, None)
            self._known[key] = login
            self._known.move_to_end(key)
            while len(self._known) > _MOST:
                self._known.popitem(last=False)

    def recall(self, kind: str, secret: str) -> Login | None:
        """Return the cached login of this credential, however old; None if unknown. Makes no query."""
        with self._lock:
            return self._known.get((kind, digest(secret)))

    def recall_recent(self, kind: str, secret: str) -> Login | None:
        """Return the cached login if it was verified within COUNTS_S, else None. Makes no query."""
        login = self.recall(kind, secret)
        return login if login is not None and self._clock() - login.checked < COUNTS_S else None

    def forget(self, kind: str, digested: str) -> None:
        """Drop a credential that belongs to no user any more."""
        with self._lock:
            self._known.pop((kind, digested), None)

    async def resolve_presser(self, found: Sequence[Credential], share: str) -> Login | None:
        """Return the user who presses the e-stop, from the cache or else the database.

        The result is None if all credentials in `found` are unknown. An expired session or token is accepted, so that
        no press is refused because of a date. `share` identifies the client, whose lookups have a queue of their own.

        Raises:
            Unverifiable: The database does not respond.
            LookupOverload: The database responds, but lookups of this client are dropped or wait too long.
        """
        for kind, secret in found:
            for remembered in (kind, _of_any_age(kind)):
                login = self.recall(remembered, secret)
                if login is not None:
                    if not self._fresh(login):
                        self._check(remembered, secret)
                    return login
        asking = [
            asyncio.create_task(self._resolve_unknown(_of_any_age(kind), secret, share))
            for kind, secret in found
        ]
        try:
            return await _first_known(asking)
        finally:
            for task in asking:
                task.cancel()

    async def resolve_stopper(self, found: Sequence[Credential], share: str) -> tuple[str, Login] | None:
        """Return the kind of the credential and the user who sends a stop or halt; None if all credentials are unknown.

        Cached credentials in `found` are tried first. A cached login is used if the database neither confirms nor
        refutes it in time. `share` and the exceptions are those of `resolve_presser`.

        Raises: Unverifiable, LookupOverload.
        """
        fault: LookupOverload | None = None
        for kind, secret in sorted(found, key=lambda one: self.recall(*one) is None):
            recalled = self.recall(kind, secret)
            if recalled is None:
                login = await self._resolve_unknown(kind, secret, share)
            else:
                login = recalled if self._fresh(recalled) else await self._checked(kind, secret, recalled)
            if isinstance(login, Login):
                return kind, login
            if isinstance(login, Unverifiable):
                raise login
            fault = fault or login
        if fault is not None:
            raise fault
        return None

    def _fresh(self, login: Login) -> bool:
        return self._clock() - login.checked < _FRESH_S

    async def _checked(self, kind: str, secret: str, login: Login) -> Login | None:
        """Return the database's answer on a cached login, or that login if the answer takes over _RECHECK_S."""
        answer = asyncio.wrap_future(self._check(kind, secret))
        await self._wait({answer}, timeout=_RECHECK_S)
        if answer.done() and answer.exception() is None:
            return answer.result()
        answer.add_done_callback(_read)
        return login

    def _resolve_unknown(self, kind: str, secret: str, share: str) -> Coroutine[Any, Any, _Said]:
        """Start to look up an uncached credential in the turn of `share`.

        The returned coroutine results in the login, or in None if the credential belongs to no user. If the database
        cannot answer, it results in the exception that says why.
        """
        if self._is_known_as_nobodys((kind, digest(secret))):
            return self._cached(None)
        return self._cached(self._check(kind, secret, share))

    async def _cached(self, lookup: Future[Login | None] | None) -> _Said:
        if lookup is None:
            return None
        came = self._clock()
        answer = asyncio.wrap_future(lookup)
        answer.add_done_callback(_read)
        try:
            while not lookup.done():  # the future of the thread may be done before the event loop notices
                await self._wait({answer}, timeout=remaining_wait(came, self._answered_at, self._clock()))
        except (Unverifiable, LookupOverload) as fault:
            return fault
        failed = lookup.exception()
        if isinstance(failed, LookupQueueFull):
            return LookupOverload(str(failed))
        return lookup.result() if failed is None else Unverifiable(_AWAY(why=failed))

    def _is_known_as_nobodys(self, key: _Key) -> bool:
        with self._lock:
            return self._nobodys.get(key, -float("inf")) > self._clock()

    def _check(self, kind: str, secret: str, share: str | None = None) -> Future[Login | None]:
        """Start a lookup without waiting, or return the pending lookup of the same credential and `share`.

        `share` identifies the client whose queue the lookup waits in. It is None for a credential with a cached login:
        such lookups have their own threads and do not wait behind lookups of unknown credentials.
        """
        key = ((kind, digest(secret)), share)
        with self._lock:
            lookup = self._asked.get(key)
            if lookup is not None:
                return lookup
            work = partial(self._query, kind, secret)
            lookups = self._remembered if share is None else self._strangers
            lookup = self._asked[key] = lookups.submit(share, work)
        lookup.add_done_callback(lambda _: self._done(key))
        return lookup

    def _done(self, key: tuple[_Key, str | None]) -> None:
        with self._lock:
            self._asked.pop(key, None)

    def _query(self, kind: str, secret: str) -> Login | None:
        """Look up a credential and return its login.

        If `kind` is one that also accepts expired credentials, the valid credential is tried first, then the expired
        one.
        """
        try:
            with short_lock_wait():
                for allowed in (*(now for now, ever in EXPIRED_ALLOWED.items() if ever == kind), kind):
                    if self.look_up(allowed, secret) is not None:
                        return self.recall(allowed, secret)
        except Exception as fault:  # any error means that the credential is unverified
            before = _faults.suffix_if_due(kind)
            if before is not None:
                log.warning("a %s was not verified: %s%s", kind, fault, before)
            raise
        finally:
            connection.close()
        return None


def remaining_wait(came: float, answered: float, now: float) -> float:
    """Return how long a caller that arrived at `came` still waits [s]; the database last responded at `answered` [s].

    Raises:
        Unverifiable: The database has answered no lookup for _PATIENCE_S.
        LookupOverload: The database answers, but the caller's lookup has waited behind others for _TURN_S.
    """
    silent = max(came, answered) + _PATIENCE_S - now
    if silent <= 0:
        raise Unverifiable(_LATE(seconds=_PATIENCE_S))
    if came + _TURN_S <= now:
        raise LookupOverload(_NO_TURN(seconds=_TURN_S))
    return min(silent, came + _TURN_S - now)


async def _first_known(asking: Sequence[asyncio.Task[_Said]]) -> Login | None:
    """Return the first user that one of the lookups finds; None if all lookups end without a user.

    Raises:
        Unverifiable: As soon as a lookup ends with this error before a user is found.
        LookupOverload: After all lookups, if none found a user and one was refused because of overload.
    """
    busy: LookupOverload | None = None
    for completed in asyncio.as_completed(asking):
        answer = await completed
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
    """Return the SHA-256 of a secret; salt and slowness are unnecessary for secrets of more than 128 random bits."""
    return hashlib.sha256(secret.encode("utf-8", "surrogateescape")).hexdigest()


def session_user(session_key: str) -> Any:
    """Return the user of a valid session from the database, None if there is none; read-only."""
    if not (session_key.isascii() and session_key.isalnum()):  # some databases cannot even query such a key
        return None
    return _logged_in(import_module(settings.SESSION_ENGINE).SessionStore(session_key))


def ended_session_user(session_key: str) -> Any:
    """Return the user of a session, also after its expiry; None after a logout or change of password."""
    if not (session_key.isascii() and session_key.isalnum()):
        return None
    row = Session.objects.filter(session_key=session_key).first()
    if row is None:
        return None
    session = import_module(settings.SESSION_ENGINE).SessionStore(session_key)
    session._session_cache = row.get_decoded()  # the store itself loads only unexpired sessions
    return _logged_in(session)


def _logged_in(session: Any) -> Any:
    asks: Any = SimpleNamespace(session=session)
    user = get_user(asks)
    return user if user.is_authenticated else None


def _read(answer: asyncio.Future[Login | None]) -> None:
    """Retrieve the exception of an abandoned lookup, so that asyncio does not log it again."""
    if not answer.cancelled():
        answer.exception()


def _logged_out(request: Any = None, **named: Any) -> None:
    session = getattr(request, "session", None)
    if session is not None and session.session_key:
        for kind in (SESSION, EXPIRED_ALLOWED[SESSION]):
            credentials.forget(kind, digest(session.session_key))


credentials = CredentialCache()
user_logged_out.connect(_logged_out, dispatch_uid="evaweb.accounts.credentials")
