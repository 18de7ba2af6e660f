"""Quota of a page's messages: as much as it needs, and no flood. What stops a robot is never counted."""

from __future__ import annotations

import time
from collections.abc import Callable

PER_SECOND = 200.0  # a page that draws, renews and drags says less than 150
AT_ONCE = 400.0


class MessageQuota:
    """So many messages at once, and so many a second from then on."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._left, self._at = AT_ONCE, clock()

    def take(self, messages: int = 1) -> bool:
        """Take so many messages from the quota; False if they are not within it."""
        now = self._clock()
        self._left = min(AT_ONCE, self._left + PER_SECOND * (now - self._at))
        self._at = now
        if self._left < messages:
            return False
        self._left -= messages
        return True
