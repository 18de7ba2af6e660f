"""Keeps threads that an encoder starts out of the real-time classes, which are control's."""

from __future__ import annotations

import contextlib
import ctypes
import os
import threading
from collections.abc import Iterator

_REAL_TIME = (os.SCHED_FIFO, os.SCHED_RR)
_LIBC = ctypes.CDLL(None)


@contextlib.contextmanager
def ordinary_threads() -> Iterator[None]:
    """Threads that are started meanwhile, and the calling one, are in the class that the caller was in before.

    SVT-AV1 puts all of its threads and the one that opens it into SCHED_FIFO at priority 99 wherever the user may
    have that: above control at its 20, which then waits for pictures to be coded.
    """
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    before = _threads()
    try:
        yield
    finally:
        _caller_back(policy, parameters.sched_priority)
        for thread in _threads() - before:
            with contextlib.suppress(ProcessLookupError):  # it has ended meanwhile
                if os.sched_getscheduler(thread) in _REAL_TIME:
                    os.sched_setscheduler(thread, policy, parameters)


def _caller_back(policy: int, priority: int) -> None:
    """By the C library, which else takes the encoder's class for the caller's, and libzmq takes over what it says."""
    parameters = ctypes.byref(ctypes.c_int(priority))  # struct sched_param has this one field
    code = _LIBC.pthread_setschedparam(ctypes.c_ulong(threading.get_ident()), policy, parameters)
    if code:
        raise OSError(code, f"the scheduling class {policy} is not given back: {os.strerror(code)}")


def _threads() -> set[int]:
    return {int(thread) for thread in os.listdir("/proc/self/task")}
