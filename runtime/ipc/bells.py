"""Wake-up signals between the station's processes, so that a reader sleeps until shared memory has something new."""

from __future__ import annotations

import os
import select
from contextlib import suppress


class Bell:
    """Wake-up signal between station processes, an inherited eventfd.

    Any process may ring it, a single process waits for it.
    """

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self._poll = select.poll()
        self._poll.register(descriptor, select.POLLIN)

    @classmethod
    def create(cls) -> Bell:
        """Create a new bell."""
        return cls(os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC))

    def ring(self) -> None:
        """Wake the process that waits now or next; never blocks."""
        os.eventfd_write(self.descriptor, 1)

    def wait(self, seconds: float) -> None:
        """Wait until the bell rings, at most `seconds`; returns at once if it was rung since the last wait."""
        if self._poll.poll(seconds * 1000.0):
            self.hush()

    def hush(self) -> None:
        """Reset the bell. Call it before reading shared memory, so that later data ring it again."""
        with suppress(BlockingIOError):  # it was not rung
            os.eventfd_read(self.descriptor)

    def close(self) -> None:
        """Close the descriptor in this process only."""
        os.close(self.descriptor)


def bells(descriptors: str) -> tuple[Bell, ...]:
    """Return the bells of a command line: inherited descriptors, separated by commas."""
    return tuple(Bell(int(descriptor)) for descriptor in descriptors.split(","))
