"""Limit of log lines that a crowd could repeat: one in some time of each name, with how often it came."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from threading import Lock

_OTHERS = None  # stands for all names that there is no room for


class LogThrottle:
    """Of `most` names each is due once in `every_s`, and all others together; from any thread."""

    def __init__(self, every_s: float, most: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._every_s, self._most, self._clock = every_s, most, clock
        self._lock = Lock()
        self._told: OrderedDict[str | None, tuple[float, int]] = (
            OrderedDict()
        )  # when, and how many came since

    def suffix_if_due(self, name: str, times: int = 1) -> str | None:
        """Suffix of the line about `name`: how often it was left unsaid, or nothing. None: say no line."""
        now = self._clock()
        with self._lock:
            entry = name if name in self._told or self._has_room(now) else _OTHERS
            told, unsaid = self._told.get(entry, (-float("inf"), 0))
            if now - told < self._every_s:
                self._told[entry] = (told, unsaid + times)
                return None
            self._told[entry] = (now, 0)
            self._told.move_to_end(entry)
        unsaid += times - 1
        names = "" if entry is name else " of other names"
        return f" ({unsaid}{names} before it)" if unsaid else ""

    def _has_room(self, now: float) -> bool:
        """The one told longest ago is forgotten where it would be told again: nothing is told more often for that."""
        names = [name for name in self._told if name is not _OTHERS]
        if len(names) >= self._most and now - self._told[names[0]][0] >= self._every_s:
            del self._told[names.pop(0)]
        return len(names) < self._most
