"""Failures in words; no Django, so that analyses outside of it say the same."""

from __future__ import annotations

UNSPECIFIED = "not specified"
_BEFORE = "not said"  # addresses that were kept say it


def is_not_said(words: str) -> bool:
    """True if these words stand for none."""
    return words.strip().casefold() in (UNSPECIFIED, _BEFORE)


def failure_text(phase: str, cause: str) -> str:
    """ "grasp: dropped"; what was not said is left out."""
    return ": ".join(filter(None, (phase, cause)))
