"""Tells a process that its parent has ended, however that came."""

from __future__ import annotations

import os
import select


class Lifeline:
    """Standard input, held open by the supervisor; its end is the supervisor's end, however it came."""

    def __init__(self, descriptor: int = 0) -> None:
        self.descriptor = descriptor

    @property
    def is_cut(self) -> bool:
        """True if the supervisor is gone."""
        readable, _, _ = select.select([self.descriptor], [], [], 0)
        return bool(readable) and os.read(self.descriptor, 4096) == b""
