"""Detection of the end of a parent process, however it ended."""

from __future__ import annotations

import os
import select


class Lifeline:
    """Standard input, which the supervisor holds open: its end of file means that the supervisor has ended."""

    def __init__(self, descriptor: int = 0) -> None:
        self.descriptor = descriptor

    @property
    def is_cut(self) -> bool:
        """True if the supervisor has ended."""
        readable, _, _ = select.select([self.descriptor], [], [], 0)
        return bool(readable) and os.read(self.descriptor, 4096) == b""
