"""Message quota of a page: enough for its work, but no flood. Stops are never counted."""

from __future__ import annotations

import time
from collections.abc import Callable

PER_SECOND = 200.0  # a page that draws, renews and drags sends fewer than 150
AT_ONCE = 400.0


class MessageQuota:
    """Token bucket: AT_ONCE messages in a burst, PER_SECOND sustained."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._left, self._at = AT_ONCE, clock()

    def take(self, messages: int = 1) -> bool:
        """Take messages from the quota; return False if they exceed it."""
        now = self._clock()
        self._left = min(AT_ONCE, self._left + PER_SECOND * (now - self._at))
        self._at = now
        if self._left < messages:
            return False
        self._left -= messages
        return True
