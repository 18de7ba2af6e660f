"""Draws that anyone can repeat: HMAC-SHA-256 of a secret key and the name of what is drawn.

Not a library's generator, because a schedule has to come out the same after years, in another version, and in the
reviewer's own program.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from collections.abc import Sequence
from typing import TypeVar

KEY_BYTES = 32
T = TypeVar("T")


def new_key() -> bytes:
    """256 bits from the operating system."""
    return secrets.token_bytes(KEY_BYTES)


class SeededDraws:
    """A sequence of draws by `key`, for what `name` says; the same for both, independent of all others."""

    def __init__(self, key: bytes, name: str) -> None:
        self._key = key
        self._name = name
        self._drawn = 0

    def below(self, n: int) -> int:
        """A whole number from 0 to `n` - 1, each equally likely: 64 bits, drawn again where they would favour some."""
        fair = 2**64 - 2**64 % n
        while True:
            message = f"{self._name}/{self._drawn}".encode()
            self._drawn += 1
            drawn = int.from_bytes(hmac.new(self._key, message, hashlib.sha256).digest()[:8], "big")
            if drawn < fair:
                return drawn % n

    def shuffled(self, items: Sequence[T]) -> list[T]:
        """`items` in an order of which each is equally likely (Fisher and Yates, from the end)."""
        found = list(items)
        for i in range(len(found) - 1, 0, -1):
            j = self.below(i + 1)
            found[i], found[j] = found[j], found[i]
        return found
