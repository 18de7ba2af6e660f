"""Rank of a text for a query: exact, prefix, word prefixes, or substring."""

from __future__ import annotations

import re
from enum import IntEnum

_WORD = re.compile(r"[^\W_]+")


class Rank(IntEnum):
    """Rank of a match; smaller is better."""

    EXACT = 0
    PREFIX = 1
    WORD = 2
    INSIDE = 3


def words_of(query: str) -> list[str]:
    """Return the distinct words of a query, case-folded."""
    return list(dict.fromkeys(query.casefold().split()))


def rank(query: str, name: str, more: str = "") -> Rank | None:
    """Return the rank of an item; None if a word of the query is neither in `name` nor in `more`.

    `more` are further searchable words.
    """
    sought, called, text = " ".join(query.casefold().split()), name.casefold(), f"{name} {more}".casefold()
    if sought == called:
        return Rank.EXACT
    if called.startswith(sought):
        return Rank.PREFIX
    parts = words_of(query)
    if not all(word in text for word in parts):
        return None
    begun = [match[0] for match in _WORD.finditer(text)] + text.split()
    return (
        Rank.WORD
        if all(any(beginning.startswith(word) for beginning in begun) for word in parts)
        else Rank.INSIDE
    )
