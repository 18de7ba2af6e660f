"""Means with Student's interval; the t distribution as a finite sum (Abramowitz and Stegun 26.7)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from .methods import solve


def student(values: Sequence[float]) -> dict[str, Any] | None:
    """Return number, mean and interval of the values; the interval is None if all are equal."""
    n = len(values)
    if not n:
        return None
    mean = math.fsum(values) / n
    if min(values) == max(values):
        return {"n": n, "mean": mean, "student": None}
    error = math.sqrt(math.fsum((value - mean) ** 2 for value in values) / (n - 1) / n)
    half = student_t(n - 1) * error
    return {"n": n, "mean": mean, "student": [mean - half, mean + half]}


def student_t(freedom: int) -> float:
    """Return the two-sided 5 % quantile of t with `freedom` degrees of freedom."""
    angle = solve(lambda a: _within(a, freedom), 0.95, 0.0, math.pi / 2)
    return math.tan(angle) * math.sqrt(freedom)


def _within(angle: float, freedom: int) -> float:
    """Return the probability of t between -x and x, for x = tan(angle) sqrt(freedom)."""
    cosine, sine = math.cos(angle), math.sin(angle)
    term, total = (1.0, 0.0) if freedom % 2 == 0 else (cosine, 0.0)
    for k in range(freedom // 2):
        total += term
        step = (2 * k + 1) / (2 * k + 2) if freedom % 2 == 0 else (2 * k + 2) / (2 * k + 3)
        term *= step * cosine * cosine
    return sine * total if freedom % 2 == 0 else 2 / math.pi * (angle + sine * total)
