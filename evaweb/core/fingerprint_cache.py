"""Cache of values computed from database rows, valid while the rows' fingerprint is unchanged; one per web process."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from threading import Lock
from typing import Generic, TypeVar

_MOST = 256  # values; with analyses of 500 trials about 100 MB
T = TypeVar("T")


class FingerprintCache(Generic[T]):
    """Least-recently-used cache of `most` values, each with the fingerprint of the rows that it was made from."""

    def __init__(self, most: int = _MOST) -> None:
        self._most = most
        self._rows: OrderedDict[Hashable, tuple[Hashable, T]] = OrderedDict()
        self._lock = Lock()

    def get(self, key: Hashable, fingerprint: Hashable, make: Callable[[], T]) -> T:
        """Return the value of `key` at this `fingerprint`; call `make` if it is missing or outdated."""
        with self._lock:
            row = self._rows.get(key)
            if row is not None and row[0] == fingerprint:
                self._rows.move_to_end(key)
                return row[1]
        value = make()  # outside the lock: concurrent callers both compute it, and neither waits
        with self._lock:
            self._rows[key] = (fingerprint, value)
            self._rows.move_to_end(key)
            while len(self._rows) > self._most:
                self._rows.popitem(last=False)
        return value

    def renew(self, key: Hashable, make: Callable[[T | None], T]) -> T:
        """Replace the value of `key` by the result of `make`, and return it.

        `make` gets the previous value, None if there is none. Concurrent callers each make a value.
        """
        with self._lock:
            row = self._rows.get(key)
        return self.get(key, object(), lambda: make(row[1] if row else None))

    def clear(self) -> None:
        """Drop all values."""
        with self._lock:
            self._rows.clear()


def rounded_sum(total: float | None) -> float:
    """Return a sum rounded to 3 decimals for use in a fingerprint, 0 for None.

    PostgreSQL adds in parallel and in varying order, so the last digits of a sum vary.
    """
    return round(total or 0.0, 3)
