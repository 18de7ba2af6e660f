"""Values made of rows, kept as long as their fingerprint stays what it was; in each process of the web."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from threading import Lock
from typing import Generic, TypeVar

_MOST = 256  # analyses of 500 trials each: some 100 MB
T = TypeVar("T")


class FingerprintCache(Generic[T]):
    """The most recently used of what was made, each with the fingerprint it was made at."""

    def __init__(self, most: int = _MOST) -> None:
        self._most = most
        self._rows: OrderedDict[Hashable, tuple[Hashable, T]] = OrderedDict()
        self._lock = Lock()

    def get(self, key: Hashable, fingerprint: Hashable, make: Callable[[], T]) -> T:
        """Value of `key` at this `fingerprint`, made now where it is not kept."""
        with self._lock:
            found = self._rows.get(key)
            if found is not None and found[0] == fingerprint:
                self._rows.move_to_end(key)
                return found[1]
        made = make()  # outside of the lock: two who ask at once both make it, and nobody waits
        with self._lock:
            self._rows[key] = (fingerprint, made)
            self._rows.move_to_end(key)
            while len(self._rows) > self._most:
                self._rows.popitem(last=False)
        return made

    def renew(self, key: Hashable, make: Callable[[T | None], T]) -> T:
        """What `make` makes of the value of before, None where there is none; two who ask at once both make theirs."""
        with self._lock:
            found = self._rows.get(key)
        return self.get(key, object(), lambda: make(found[1] if found else None))

    def clear(self) -> None:
        """Forget all of it."""
        with self._lock:
            self._rows.clear()


def rounded_sum(total: float | None) -> float:
    """A sum of numbers as part of a fingerprint.

    PostgreSQL adds up on several cores, in another order each time, and the last digits are chance.
    """
    return round(total or 0.0, 3)
