"""Browser sessions, which begin with the PIN.

A session is valid for LASTS_S, until another PIN is set or the panel restarts.
"""

from __future__ import annotations

import hashlib
import secrets
import threading
import time
from collections import OrderedDict
from collections.abc import Callable

from runtime.clients.panel.pin import Attempts, PinFile
from runtime.core.errors import ConfigurationError

LASTS_S = 12 * 3600.0
_MOST = 32


class Refusal(ConfigurationError):
    """Error that the PIN is not accepted; `wait_s`: time until the next PIN from this source is checked [s]."""

    def __init__(self, why: str, wait_s: float = 0.0) -> None:
        super().__init__(why)
        self.wait_s = wait_s


class Sessions:
    """Open sessions of browsers that have entered the PIN; thread-safe."""

    def __init__(self, pin: PinFile, attempts: Attempts, now: Callable[[], float] = time.monotonic) -> None:
        self._pin, self._attempts, self._now = pin, attempts, now
        self._open: OrderedDict[bytes, tuple[float, tuple[int, int]]] = OrderedDict()
        self._trying, self._lock = threading.Lock(), threading.Lock()

    def begin(self, pin: str, source: str) -> str:
        """Check the PIN and return the secret of a new session. Raises: Refusal.

        One PIN is checked at a time: parallel attempts gain nothing and cost little.
        """
        if not self._trying.acquire(blocking=False):
            raise Refusal("another PIN is being looked at: try again", 1.0)
        try:
            if (wait := self._attempts.wait(source)) > 0:
                raise Refusal(f"too many wrong PINs: wait {wait:.0f} s; the E-STOP needs none", wait)
            version = self._pin.version
            try:
                right = self._pin.matches(pin)
            except ConfigurationError as fault:
                raise Refusal(str(fault)) from None
            if not right:
                self._attempts.failed(source)
                raise Refusal("wrong PIN", self._attempts.wait(source))
            self._attempts.passed(source)
        finally:
            self._trying.release()
        secret = secrets.token_urlsafe(32)
        with self._lock:
            self._open[_digest(secret)] = (self._now() + LASTS_S, version)
            if len(self._open) > _MOST:
                self._open.popitem(last=False)
        return secret

    def holds(self, secret: str) -> bool:
        """Return True if the secret belongs to an open session."""
        with self._lock:
            until, version = self._open.get(_digest(secret), (0.0, (0, 0)))
        return self._now() < until and version == self._pin.version != (0, 0)

    def end(self, secret: str) -> None:
        """End the session."""
        with self._lock:
            self._open.pop(_digest(secret), None)


def _digest(secret: str) -> bytes:
    return hashlib.sha256(secret.encode("utf-8", "replace")).digest()
