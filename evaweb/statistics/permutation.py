"""Permutation test of paired differences: if both arms are equal, each difference may as well have the other sign.

This is Fisher's test by sign flips (1935). All combinations of signs are counted by their sums; none is sampled.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from evaweb.statistics.base import StatisticsError

# Differences are rounded to the finest of these fractions of 1 for which the sums are few enough to count; the first
# represents hundredths and every fraction with a denominator up to 10 exactly. A difference and its opposite are
# rounded alike, so that the test stays exact.
PARTS = (25_200, 2_520, 420, 60, 12)
_MOST = 10_000_000  # greatest product of sums and differences


@dataclass(frozen=True, slots=True)
class SignFlipTest:
    """Mean difference of `pairs`, and the two-sided probability that chance gives a mean at least as far from 0."""

    pairs: int
    value: float
    p: float


def sign_flip_test(differences: Sequence[float], widest: float = 1.0) -> SignFlipTest:
    """Return the sign-flip test of `differences` (-widest to widest); the number of pairs must be fixed beforehand.

    Exact: all 2^n combinations of signs are counted.

    Raises:
        StatisticsError: If there is no difference, or one is outside -widest to widest.
    """
    if not differences:
        raise StatisticsError("no pair: a permutation test needs at least one")
    wrong = [d for d in differences if not abs(d) <= widest * (1 + 1e-9)]
    if wrong:
        raise StatisticsError(f"a difference of {wrong[0]}; allowed: {-widest:g} to {widest:g}")
    value = math.fsum(differences) / len(differences)
    return SignFlipTest(len(differences), value, _p(_in_parts([d / widest for d in differences])))


def _in_parts(shares: Sequence[float]) -> list[int]:
    """Return the non-zero `shares` as integers in a common unit."""
    units: list[int] = []
    for parts in PARTS:
        units = [unit for share in shares if (unit := round(share * parts))]
        common = math.gcd(*units) if units else 1
        units = [unit // common for unit in units]
        if sum(map(abs, units)) * len(units) <= _MOST:
            break
    return units


def _p(units: Sequence[int]) -> float:
    import numpy as np

    total, observed = sum(map(abs, units)), abs(sum(units))
    if not observed:
        return 1.0
    # Probability of each sum of the differences that come out negative.
    below, reached = np.zeros(total + 1), 0
    below[0] = 1.0
    for unit in sorted(map(abs, units)):
        reached += unit
        below[unit : reached + 1] += below[: reached - unit + 1].copy()
        below[: reached + 1] /= 2
    return min(1.0, 2 * float(below[: (total - observed) // 2 + 1].sum()))
