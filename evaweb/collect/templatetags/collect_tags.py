"""Template filters for times on the Collect page."""

from __future__ import annotations

from django import template

register = template.Library()
_MINUTE = 60


@register.filter
def time_left(seconds: float | str | None) -> str:
    """Return the remaining time, rounded, as text; templates pass "" if it is unknown."""
    if not isinstance(seconds, float | int):
        return "time left not known yet"
    if seconds < 1:
        return "a moment left"
    if seconds < 2 * _MINUTE:
        return f"about {seconds:.0f} s left"
    return f"about {seconds / _MINUTE:.0f} min left"


@register.filter
def duration(seconds: float | str | None) -> str:
    """Return seconds with one decimal; a dash if unknown."""
    return f"{seconds:.1f} s" if isinstance(seconds, float | int) else "–"
