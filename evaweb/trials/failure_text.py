"""Failures as text; independent of Django, so that external analyses share it."""

from __future__ import annotations

UNSPECIFIED = "not specified"
_BEFORE = "not said"  # earlier name, still in bookmarked URLs


def is_unspecified(words: str) -> bool:
    """Return True if the text stands for an unspecified failure."""
    return words.strip().casefold() in (UNSPECIFIED, _BEFORE)


def failure_text(phase: str, cause: str) -> str:
    """Return phase and cause as "grasp: dropped"; an empty part is omitted."""
    return ": ".join(filter(None, (phase, cause)))
