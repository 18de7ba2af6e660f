"""Passwords are hashed one after the other, behind everything else: however many log in at once, a stop is not later.

A hash is half a second of a processor. A login that comes when too many wait is asked to try again.
"""

from __future__ import annotations

import os
import threading
from concurrent.futures import ThreadPoolExecutor

from django.contrib.auth.hashers import PBKDF2PasswordHasher

from evaweb.errors import EvaError
from runtime.core.sentences import fixed

_TOO_MANY_PASSWORDS_BEING_CHECKED = fixed(
    "web.hashing.too_many_passwords_being_checked",
    "too many passwords are being checked: try again in a few seconds",
)

_MOST_WAITING = 16
_NICE = 10


class Busy(EvaError):
    """Too many passwords are being checked."""

    status = 503


def _give_way() -> None:
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)  # of this thread alone


_thread = ThreadPoolExecutor(1, "passwords", initializer=_give_way)
_places = threading.BoundedSemaphore(_MOST_WAITING)


class QueuedHasher(PBKDF2PasswordHasher):
    """Django's own hashes, made in one thread of this process."""

    def encode(self, password: str, salt: str, iterations: int | None = None) -> str:
        """The hash; raises Busy."""
        if not _places.acquire(blocking=False):
            raise Busy(_TOO_MANY_PASSWORDS_BEING_CHECKED)
        try:
            made: str = _thread.submit(super().encode, password, salt, iterations).result()
            return made
        finally:
            _places.release()
