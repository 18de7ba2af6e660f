"""Questions to the database that strangers can cause: each caller has a share, and a crowd waits behind itself."""

from __future__ import annotations

import logging
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Lock
from typing import Generic, TypeVar

log = logging.getLogger(__name__)
T = TypeVar("T")
_MOST = 1024  # that wait, of all shares together


class LookupQueueFull(Exception):
    """There is no place to wait for this one."""

    def __init__(self) -> None:
        super().__init__("too many logins from this address are looked up at once")


class FairLookupPool(Generic[T]):
    """Work in `threads`, the oldest of each share in turn; from any thread, and none of its callers waits.

    Each thread does `begin` first.

    Where `most` wait, the newest of the share that has most of them gives way, or is not taken: it fails with Crowded.
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
        """Result of `work`, once it had its turn."""
        answer: Future[T] = Future()
        answer.set_running_or_notify_cancel()  # who stops waiting for it ends nobody else's
        with self._lock:
            turned_away = self._place_for(share, answer)
            if turned_away is not answer:
                self._shares.setdefault(share, deque()).append((work, answer))
                self._waiting += 1
        if turned_away is not None:
            turned_away.set_exception(LookupQueueFull())
        if turned_away is None:  # else a thread is promised to the one that gave way
            try:
                self._threads.submit(self._next)
            except RuntimeError as error:  # no more threads: it waits for those that there are
                log.error("%s", error)
        return answer

    def _place_for(self, share: Hashable, answer: Future[T]) -> Future[T] | None:
        """Look-up to drop so that one of this share may wait: None, `answer`, or one of a longer share."""
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
                self._shares[share] = waiting  # behind all others
            self._waiting -= 1
        try:
            found = work()
        except BaseException as fault:
            answer.set_exception(fault)
        else:
            answer.set_result(found)
