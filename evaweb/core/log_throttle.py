"""Rate limit for repeated log lines: one line per name and period, with a count of the suppressed ones."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from threading import Lock

_OTHERS = None  # common entry of all names beyond `most`


class LogThrottle:
    """Rate limit of one line per name and `every_s` [s]. Thread-safe.

    If there are more than `most` names, the further ones share one limit.
    """

    def __init__(self, every_s: float, most: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._every_s, self._most, self._clock = every_s, most, clock
        self._lock = Lock()
        self._told: OrderedDict[str | None, tuple[float, int]] = (
            OrderedDict()
        )  # time of the last line; number suppressed since

    def suffix_if_due(self, name: str, times: int = 1) -> str | None:
        """Return the suffix of the next line about `name` (how many were suppressed), or None to suppress it."""
        now = self._clock()
        with self._lock:
            entry = name if name in self._told or self._has_room(now) else _OTHERS
            logged_at, unsaid = self._told.get(entry, (-float("inf"), 0))
            if now - logged_at < self._every_s:
                self._told[entry] = (logged_at, unsaid + times)
                return None
            self._told[entry] = (now, 0)
            self._told.move_to_end(entry)
        unsaid += times - 1
        names = "" if entry is name else " of other names"
        return f" ({unsaid}{names} before it)" if unsaid else ""

    def _has_room(self, now: float) -> bool:
        """Return True if another name can be tracked; drop the oldest if its period is over, which loses nothing."""
        names = [name for name in self._told if name is not _OTHERS]
        if len(names) >= self._most and now - self._told[names[0]][0] >= self._every_s:
            del self._told[names.pop(0)]
        return len(names) < self._most
