"""Reproducible random draws: HMAC-SHA-256 of a secret key and the name of the drawn quantity.

Not a library's generator, because a schedule must be reproducible after years, with other versions, and by a reviewer's
own program.
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
    """Return 256 random bits from the operating system."""
    return secrets.token_bytes(KEY_BYTES)


class SeededDraws:
    """Sequence of draws determined by `key` and `name`, independent of sequences with other names."""

    def __init__(self, key: bytes, name: str) -> None:
        self._key = key
        self._name = name
        self._drawn = 0

    def below(self, n: int) -> int:
        """Return an integer from 0 to `n` - 1, uniformly: 64 bits, redrawn if they would introduce a bias."""
        fair = 2**64 - 2**64 % n
        while True:
            message = f"{self._name}/{self._drawn}".encode()
            self._drawn += 1
            drawn = int.from_bytes(hmac.new(self._key, message, hashlib.sha256).digest()[:8], "big")
            if drawn < fair:
                return drawn % n

    def shuffled(self, items: Sequence[T]) -> list[T]:
        """Return `items` in a uniformly random order (Fisher-Yates, from the end)."""
        shuffled = list(items)
        for i in range(len(shuffled) - 1, 0, -1):
            j = self.below(i + 1)
            shuffled[i], shuffled[j] = shuffled[j], shuffled[i]
        return shuffled
