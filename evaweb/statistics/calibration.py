"""Calibration of predicted probabilities against observed frequencies.

Brier score: Brier (1950). Reliability table: Murphy and Winkler (1977). Expected calibration error: Naeini, Cooper and
Hauskrecht (2015); it is biased upwards if bins hold few predictions.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

from evaweb.statistics.base import StatisticsError, check_share

BINS = 10
_EDGES = [k / BINS for k in range(1, BINS)]


@dataclass(frozen=True, slots=True)
class Bin:
    """Predictions from `low` to below `high`: their number, mean, and number of true outcomes.

    The last bin includes its upper end.
    """

    low: float
    high: float
    n: int
    probability: float
    true: int


@dataclass(frozen=True, slots=True)
class Calibration:
    """Brier score, expected calibration error and non-empty bins of `n` predictions."""

    n: int
    brier: float
    error: float
    bins: tuple[Bin, ...]


def calibration(pairs: Sequence[tuple[float, bool]]) -> Calibration:
    """Return the calibration of (probability, outcome) pairs in ten bins of equal width.

    Raises:
        StatisticsError: If there are none, or a probability lies outside 0 to 1.
    """
    if not pairs:
        raise StatisticsError("no probability was given")
    for probability, _ in pairs:
        check_share("probability", probability)
    n, binned = len(pairs), [list[tuple[float, bool]]() for _ in range(BINS)]
    for pair in pairs:
        binned[bisect_right(_EDGES, pair[0])].append(pair)
    bins = tuple(
        Bin(
            k / BINS,
            (k + 1) / BINS,
            len(members),
            sum(p for p, _ in members) / len(members),
            sum(true for _, true in members),
        )
        for k, members in enumerate(binned)
        if members
    )
    return Calibration(
        n,
        sum((probability - true) ** 2 for probability, true in pairs) / n,
        sum(abs(members.n * members.probability - members.true) for members in bins) / n,
        bins,
    )
