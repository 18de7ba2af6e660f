"""Password hashing in one low-priority thread, so that many simultaneous logins do not delay a stop.

A hash takes half a second of CPU time. The client addresses take turns; if too many logins wait, one from the address
with the most waiting logins is refused, and its user asked to try again.
"""

from __future__ import annotations

import os
import threading
from functools import partial

from django.contrib.auth.hashers import PBKDF2PasswordHasher

from evaweb.accounts.client_addresses import SHARE
from evaweb.accounts.lookup_pool import FairLookupPool, LookupQueueFull
from evaweb.core.errors import EvaError
from runtime.core.sentences import fixed

_TOO_MANY_PASSWORDS_BEING_CHECKED = fixed(
    "web.hashing.too_many_passwords_being_checked",
    "too many passwords are being checked: try again in a few seconds",
)

_MOST_WAITING = 16
_NICE = 10


class HashingOverload(EvaError):
    """Error if too many passwords are being checked."""

    status = 503
    retry_after_s = 5


def _lower_priority() -> None:
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)  # on Linux this affects the thread only


_turns: FairLookupPool[str] = FairLookupPool(1, _MOST_WAITING, "passwords", _lower_priority)


class QueuedHasher(PBKDF2PasswordHasher):
    """Password hasher like Django's PBKDF2 hasher that computes in one thread of this process."""

    def encode(self, password: str, salt: str, iterations: int | None = None) -> str:
        """Return the hash. Raises: HashingOverload if too many are waiting."""
        try:
            return _turns.submit(SHARE.get(), partial(super().encode, password, salt, iterations)).result()
        except LookupQueueFull:
            raise HashingOverload(_TOO_MANY_PASSWORDS_BEING_CHECKED) from None
