"""Means as text; independent of Django, so that external analyses share it."""

from __future__ import annotations

from evaweb.statistics.means import Average


def average_text(found: Average | None, of: int) -> str:
    """Return a mean such as "−5.21 [−5.60, −4.82], 14 of 16 trials"; "" if no trial has a value."""
    if found is None:
        return ""
    n = f"n {found.n}" if found.n == of else f"{found.n} of {of} trials"
    if found.interval is None:
        return f"{_decimal(found.value)}, {n}: no interval"
    return f"{_decimal(found.value)} [{_decimal(found.interval.low)}, {_decimal(found.interval.high)}], {n}"


def _decimal(value: float) -> str:
    return f"{value:.2f}".replace("-", "−")
