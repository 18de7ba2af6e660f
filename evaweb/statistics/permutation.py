"""The permutation test of paired differences: had both arms been the same, each difference could as well have been
turned round.

Formulae: Fisher's sign flips (1935), all of them counted by way of their sums, not drawn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from evaweb.statistics.base import StatisticsError

# Differences are taken to the finest of these parts of 1 at which the sums are few enough to be counted: the first
# holds hundredths and every fraction with a denominator up to 10. The same parts for a difference and its opposite, so
# that the test stays exact whatever is rounded.
PARTS = (25_200, 2_520, 420, 60, 12)
_MOST = 10_000_000  # sums times differences


@dataclass(frozen=True, slots=True)
class SignFlipTest:
    """Mean of the differences of `pairs`, and the two-sided probability of one as far from 0 by chance."""

    pairs: int
    value: float
    p: float


def sign_flip_test(differences: Sequence[float], widest: float = 1.0) -> SignFlipTest:
    """The test of `differences` from -widest to widest, of pairs whose number was fixed beforehand.

    Exact: every one of the 2^n ways in which the signs may fall is counted. StatisticsError where there is none, or
    one lies outside.
    """
    if not differences:
        raise StatisticsError("no pair: a permutation test needs at least one")
    wrong = [d for d in differences if not abs(d) <= widest * (1 + 1e-9)]
    if wrong:
        raise StatisticsError(f"a difference of {wrong[0]}; allowed: {-widest:g} to {widest:g}")
    value = math.fsum(differences) / len(differences)
    return SignFlipTest(len(differences), value, _p(_in_parts([d / widest for d in differences])))


def _in_parts(shares: Sequence[float]) -> list[int]:
    """`shares` in whole parts, those of 0 left out."""
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
    # Probability of each sum of those differences that come out below 0.
    below, reached = np.zeros(total + 1), 0
    below[0] = 1.0
    for unit in sorted(map(abs, units)):
        reached += unit
        below[unit : reached + 1] += below[: reached - unit + 1].copy()
        below[: reached + 1] /= 2
    return min(1.0, 2 * float(below[: (total - observed) // 2 + 1].sum()))
