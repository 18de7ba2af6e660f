"""A thread that gives way to all others, and sends no more than it may."""

from __future__ import annotations

import ctypes
import os
import platform
import threading
import time
from collections.abc import Callable

_NICEST = 19
_IDLE, _OF_THREAD = 3 << 13, 1  # IOPRIO_CLASS_IDLE, IOPRIO_WHO_PROCESS
_IOPRIO_SET = {"x86_64": 251, "aarch64": 30}


def lower_priority() -> None:
    """Put the calling thread, and those that it starts, last: nice 19, and the disk while nobody else wants it.

    Whoever reads in that class is served when the disk is idle, where its scheduler knows classes; else as all others.
    """
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICEST)
    number = _IOPRIO_SET.get(platform.machine())
    if number is not None:
        ctypes.CDLL(None).syscall(number, _OF_THREAD, 0, _IDLE)


class Throttle:
    """A bucket of bytes that fills at `rate` a second and holds `burst`: who takes more waits until it is paid for."""

    def __init__(self, rate: float, burst: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate, self._burst, self._clock = rate, burst, clock
        self._left, self._at = burst, clock()

    def wait_s(self) -> float:
        """Seconds until something may be taken; 0 now."""
        now = self._clock()
        self._left, self._at = min(self._burst, self._left + self._rate * (now - self._at)), now
        return max(0.0, -self._left / self._rate)

    def consume(self, count: int) -> None:
        """So many bytes are sent; to be asked for with `wait_s` before."""
        self._left -= count
