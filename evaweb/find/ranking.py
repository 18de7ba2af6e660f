"""How well a text fits what was typed: exactly, as its beginning, as the beginning of its words, anywhere in it."""

from __future__ import annotations

import re
from enum import IntEnum

_WORD = re.compile(r"[^\W_]+")


class Rank(IntEnum):
    """The smaller, the nearer to the top."""

    EXACT = 0
    PREFIX = 1
    WORD = 2
    INSIDE = 3


def words_of(query: str) -> list[str]:
    """The words of a query, each once, as they are compared."""
    return list(dict.fromkeys(query.casefold().split()))


def rank(query: str, name: str, more: str = "") -> Rank | None:
    """Rank of a thing with that name; `more` is what else it is known by. None where a word is in neither."""
    wanted, called, text = " ".join(query.casefold().split()), name.casefold(), f"{name} {more}".casefold()
    if wanted == called:
        return Rank.EXACT
    if called.startswith(wanted):
        return Rank.PREFIX
    words = words_of(query)
    if not all(word in text for word in words):
        return None
    begun = [found[0] for found in _WORD.finditer(text)] + text.split()
    return Rank.WORD if all(any(one.startswith(word) for one in begun) for word in words) else Rank.INSIDE
