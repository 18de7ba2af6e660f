"""Who a session or token stands for: asked of the database, remembered for when it does not answer.

What is remembered never expires by itself: stopping works with it as long as this process lives. It is forgotten when
the database says otherwise, which is asked again whenever it is used and older than a few seconds.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from importlib import import_module
from types import SimpleNamespace
from typing import Any

from django.conf import settings
from django.contrib.auth import get_user, get_user_model
from django.contrib.auth.signals import user_logged_out
from django.contrib.sessions.models import Session
from django.db import connection

from evaweb.lock_wait import hurried
from evaweb.roles import Role, role_of

log = logging.getLogger(__name__)
SESSION, TOKEN = "session", "token"
OF_ANY_AGE = {
    kind: f"{kind} of any age" for kind in (SESSION, TOKEN)
}  # also where its time is over: for an e-stop
UNVERIFIED = "unverified"  # the name of who presses while the database does not say who they are
_MOST = 4096  # remembered
_MOST_ASKED = 64  # at once; beyond, the database is as good as gone
_THREADS = 4
_FRESH_S = 5.0  # for which an answer of the database is taken without asking again
COUNTS_S = 60.0  # for which it counts for what is no stop and needs no row, where the database says nothing
_PATIENCE_S = 0.5  # for which who is not remembered waits for the database
_RECHECK_S = 0.25  # for which a stop of somebody who is remembered waits for it; an e-stop never does


class Unverifiable(Exception):
    """The database did not say whose credential this is."""


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


class Credentials:
    """What this process has verified; from any thread."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._known: OrderedDict[tuple[str, str], Login] = OrderedDict()
        self._asked: dict[tuple[str, str], Future[Login | None]] = {}
        self._threads = ThreadPoolExecutor(_THREADS, "credentials")
        self._owners: dict[str, Callable[[str], Any]] = {
            SESSION: session_user,
            OF_ANY_AGE[SESSION]: ended_session_user,
        }

    def learn(self, kind: str, owner: Callable[[str], Any]) -> None:
        """How the user of a credential of that kind is found in the database, None where there is none."""
        self._owners[kind] = owner

    def look(self, kind: str, secret: str) -> Any:
        """The user as the database has them now, None where nobody's; in the caller's thread. Raises its Error."""
        user = self._owners[kind](secret)
        if user is None:
            self.forget(kind, digest(secret))
        else:
            self.note(kind, secret, user)
        return user

    def note(self, kind: str, secret: str, user: Any) -> None:
        """The database has just said that it is this user's."""
        login = Login(user.pk, user.get_username(), role_of(user), self._clock())
        key = (kind, digest(secret))
        with self._lock:
            self._known[key] = login
            self._known.move_to_end(key)
            while len(self._known) > _MOST:
                self._known.popitem(last=False)

    def recall(self, kind: str, secret: str) -> Login | None:
        """Who it stood for when the database was last asked; without asking."""
        with self._lock:
            return self._known.get((kind, digest(secret)))

    def counted(self, kind: str, secret: str) -> Login | None:
        """Who it stands for as the database said within the last minute; without asking."""
        known = self.recall(kind, secret)
        return known if known is not None and self._clock() - known.checked < COUNTS_S else None

    def forget(self, kind: str, digested: str) -> None:
        """It is nobody's any more."""
        with self._lock:
            self._known.pop((kind, digested), None)

    async def presser(self, kind: str, secret: str) -> Login | None:
        """Whose e-stop this is: at once where they are remembered, else within half a second.

        No press is lost for a date: a credential whose time is over is one here. None: the database says that it is
        nobody's. Raises Unverifiable where it says nothing.
        """
        ended = OF_ANY_AGE.get(kind, kind)
        for remembered in (kind, ended):
            known = self.recall(remembered, secret)
            if known is not None:
                if not self._fresh(known):
                    self._check(remembered, secret)
                return known
        login = await self._answer(kind, secret, _PATIENCE_S)
        return login if login or ended == kind else await self._answer(ended, secret, _PATIENCE_S)

    async def stopper(self, kind: str, secret: str) -> Login | None:
        """Whose stop or halt this is, as the database says, or as it said last where it does not answer."""
        known = self.recall(kind, secret)
        if known is not None and self._fresh(known):
            return known
        try:
            return await self._answer(kind, secret, _PATIENCE_S if known is None else _RECHECK_S)
        except Unverifiable:
            if known is None:
                raise
            return known

    def _fresh(self, known: Login) -> bool:
        return self._clock() - known.checked < _FRESH_S

    async def _answer(self, kind: str, secret: str, patience: float) -> Login | None:
        answer = asyncio.wrap_future(self._check(kind, secret))
        done, _ = await asyncio.wait({answer}, timeout=patience)
        if not done:
            answer.add_done_callback(_heard)
            raise Unverifiable(f"the database did not answer within {patience:g} s")
        fault = answer.exception()
        if fault is not None:
            raise Unverifiable(f"the database does not answer: {fault}")
        return answer.result()

    def _check(self, kind: str, secret: str) -> Future[Login | None]:
        """Ask the database, once for all who want to know the same; nobody waits here."""
        key = (kind, digest(secret))
        with self._lock:
            asked = self._asked.get(key)
            if asked is not None:
                return asked
            asked = self._asked[key] = Future()
            asked.set_running_or_notify_cancel()  # who stops waiting for it ends nobody else's
            crowded = len(self._asked) > _MOST_ASKED
        if crowded:
            self._say(key, asked, fault=Unverifiable("too many logins are looked up at once"))
        else:
            self._threads.submit(self._ask, key, secret, asked)
        return asked

    def _ask(self, key: tuple[str, str], secret: str, asked: Future[Login | None]) -> None:
        try:
            with hurried():
                found = self.look(key[0], secret)
        except Exception as fault:  # whatever it is: the database has not said who this is
            log.warning("a %s was not verified: %s", key[0], fault)
            self._say(key, asked, fault=fault)
        else:
            self._say(key, asked, None if found is None else self.recall(key[0], secret))
        finally:
            connection.close()

    def _say(
        self,
        key: tuple[str, str],
        asked: Future[Login | None],
        login: Login | None = None,
        fault: Exception | None = None,
    ) -> None:
        with self._lock:
            self._asked.pop(key, None)
        if fault is not None:
            asked.set_exception(fault)
        else:
            asked.set_result(login)


def digest(secret: str) -> str:
    """Not salted and not slow: a secret of more than 128 random bits cannot be guessed."""
    return hashlib.sha256(secret.encode("utf-8", "surrogateescape")).hexdigest()


def session_user(session_key: str) -> Any:
    """The user who is logged in with that session, as the database has them now; reads only."""
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


def _heard(answer: asyncio.Future[Login | None]) -> None:
    """Nobody waits for it any more: its error was logged where it arose."""
    if not answer.cancelled():
        answer.exception()


def _logged_out(request: Any = None, **named: Any) -> None:
    session = getattr(request, "session", None)
    if session is not None and session.session_key:
        for kind in (SESSION, OF_ANY_AGE[SESSION]):
            credentials.forget(kind, digest(session.session_key))


credentials = Credentials()
user_logged_out.connect(_logged_out, dispatch_uid="evaweb.credentials")
