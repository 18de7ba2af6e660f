"""Lowest priority for a thread, and a limiter for the rate at which it sends."""

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
    """Give the calling thread and the threads that it starts the lowest priority.

    That is nice 19 and the idle class of disk access, which takes effect only if the disk's scheduler supports classes.
    """
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICEST)
    number = _IOPRIO_SET.get(platform.machine())
    if number is not None:
        ctypes.CDLL(None).syscall(number, _OF_THREAD, 0, _IDLE)


class Throttle:
    """Token bucket of bytes that fills at `rate` [bytes/s] and holds `burst` bytes.

    More bytes than it holds may be taken; the deficit is made up by waiting.
    """

    def __init__(self, rate: float, burst: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate, self._burst, self._clock = rate, burst, clock
        self._left, self._at = burst, clock()

    def wait_s(self) -> float:
        """Return the time until bytes may be taken [s]; 0 means now."""
        now = self._clock()
        self._left, self._at = min(self._burst, self._left + self._rate * (now - self._at)), now
        return max(0.0, -self._left / self._rate)

    def consume(self, count: int) -> None:
        """Record that `count` bytes are sent; call `wait_s` before."""
        self._left -= count
