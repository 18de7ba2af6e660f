"""Keeps threads that an encoder starts out of the real-time classes, which are control's."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

_REAL_TIME = (os.SCHED_FIFO, os.SCHED_RR)


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
        os.sched_setscheduler(0, policy, parameters)
        for thread in _threads() - before:
            with contextlib.suppress(ProcessLookupError):  # it has ended meanwhile
                if os.sched_getscheduler(thread) in _REAL_TIME:
                    os.sched_setscheduler(thread, policy, parameters)


def _threads() -> set[int]:
    return {int(thread) for thread in os.listdir("/proc/self/task")}
