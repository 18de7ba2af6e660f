"""Bells: who puts something into the shared state for a process that sleeps wakes it, and nobody looks in vain."""

from __future__ import annotations

import os
import select
from contextlib import suppress


class Bell:
    """An eventfd that the family inherits: any process rings it, the one that it is for waits for it."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self._poll = select.poll()
        self._poll.register(descriptor, select.POLLIN)

    @classmethod
    def made(cls) -> Bell:
        """A new one."""
        return cls(os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC))

    def ring(self) -> None:
        """Wake who waits, or who waits next; never blocks."""
        os.eventfd_write(self.descriptor, 1)

    def wait(self, seconds: float) -> None:
        """Return when it was rung since the last time, or after so long."""
        if self._poll.poll(seconds * 1000.0):
            self.hush()

    def hush(self) -> None:
        """Forget that it was rung, before one looks at what for: what comes later rings again."""
        with suppress(BlockingIOError):  # it was not
            os.eventfd_read(self.descriptor)

    def close(self) -> None:
        """Let go of it; others keep theirs."""
        os.close(self.descriptor)


def bells(descriptors: str) -> tuple[Bell, ...]:
    """Those of a command line: inherited descriptors, separated by commas."""
    return tuple(Bell(int(descriptor)) for descriptor in descriptors.split(","))
