"""Passwords are hashed one after the other, behind everything else: however many log in at once, a stop is not later.

A hash is half a second of a processor. Each address has its turn, so that a crowd waits behind itself; where too many
wait, a login of the crowd is asked to try again.
"""

from __future__ import annotations

import os
import threading
from functools import partial

from django.contrib.auth.hashers import PBKDF2PasswordHasher

from evaweb.callers import SHARE
from evaweb.errors import EvaError
from evaweb.lookups import FairLookupPool, LookupQueueFull
from runtime.core.sentences import fixed

_TOO_MANY_PASSWORDS_BEING_CHECKED = fixed(
    "web.hashing.too_many_passwords_being_checked",
    "too many passwords are being checked: try again in a few seconds",
)

_MOST_WAITING = 16
_NICE = 10


class HashingOverload(EvaError):
    """Too many passwords are being checked."""

    status = 503
    retry_after_s = 5


def _give_way() -> None:
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)  # of this thread alone


_turns: FairLookupPool[str] = FairLookupPool(1, _MOST_WAITING, "passwords", _give_way)


class QueuedHasher(PBKDF2PasswordHasher):
    """Django's own hashes, made in one thread of this process."""

    def encode(self, password: str, salt: str, iterations: int | None = None) -> str:
        """The hash; raises Busy."""
        try:
            return _turns.submit(SHARE.get(), partial(super().encode, password, salt, iterations)).result()
        except LookupQueueFull:
            raise HashingOverload(_TOO_MANY_PASSWORDS_BEING_CHECKED) from None
