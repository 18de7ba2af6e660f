"""Thread pool for database lookups that unknown clients can cause.

Each client has a share, so that many lookups of one client delay only that client.
"""

from __future__ import annotations

import logging
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Lock
from typing import Generic, TypeVar

log = logging.getLogger(__name__)
T = TypeVar("T")
_MOST = 1024  # queued lookups of all shares


class LookupQueueFull(Exception):
    """Error if the queue of lookups is full."""

    def __init__(self) -> None:
        super().__init__("too many logins from this address are looked up at once")


class FairLookupPool(Generic[T]):
    """Pool of `threads` threads with one queue per share (usually a client); the queues take turns. Thread-safe.

    `submit` never blocks. Each thread calls `begin` before its first work. At most `most` pieces of work wait: beyond
    that, either the newest work of the longest queue is dropped, or the new work is refused. The future of the dropped
    or refused work fails with LookupQueueFull.
    """

    def __init__(
        self,
        threads: int,
        most: int = _MOST,
        name: str = "lookups",
        begin: Callable[[], None] | None = None,
    ) -> None:
        self._most = most
        self._lock = Lock()
        self._shares: OrderedDict[Hashable, deque[tuple[Callable[[], T], Future[T]]]] = OrderedDict()
        self._waiting = 0
        self._threads = ThreadPoolExecutor(threads, name, initializer=begin)

    def submit(self, share: Hashable, work: Callable[[], T]) -> Future[T]:
        """Queue `work` in the queue of `share`, usually a client, and return the future of its result."""
        answer: Future[T] = Future()
        answer.set_running_or_notify_cancel()  # shared by callers: one must not cancel it for others
        with self._lock:
            turned_away = self._place_for(share, answer)
            if turned_away is not answer:
                self._shares.setdefault(share, deque()).append((work, answer))
                self._waiting += 1
        if turned_away is not None:
            turned_away.set_exception(LookupQueueFull())
        if turned_away is None:  # otherwise the removed work's thread task serves this one
            try:
                self._threads.submit(self._next)
            except RuntimeError as error:  # cannot start a thread: existing ones serve it later
                log.error("%s", error)
        return answer

    def _place_for(self, share: Hashable, answer: Future[T]) -> Future[T] | None:
        """Make room for one more piece of work of `share`, and return the future that has to fail for it.

        If there is room already, no future has to fail: the result is None. If the pool is full, the newest work of the
        longest queue is removed, and its future is returned. But if the new work would make the queue of `share` the
        longest, nothing is removed: the new work is refused, and its future, `answer`, is returned.
        """
        if self._waiting < self._most:
            return None
        longest = max(self._shares.values(), key=len)
        if len(longest) <= len(self._shares.get(share, ())) + 1:
            return answer
        self._waiting -= 1
        return longest.pop()[1]

    def _next(self) -> None:
        with self._lock:
            share, waiting = self._shares.popitem(last=False)
            work, answer = waiting.popleft()
            if waiting:
                self._shares[share] = waiting  # at the end of the rotation
            self._waiting -= 1
        try:
            result = work()
        except BaseException as fault:
            answer.set_exception(fault)
        else:
            answer.set_result(result)
