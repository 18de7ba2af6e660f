"""Agreement of two raters of the same trials beyond chance.

Formulae: Cohen (1960); Gwet's AC1 (2008), because kappa collapses if nearly all trials end alike;
Krippendorff's alpha (2004) for missing ratings.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Hashable, Sequence
from itertools import permutations
from typing import Literal

from evaweb.statistics.base import StatisticsError

Metric = Literal["nominal", "interval"]


def cohen_kappa(pairs: Sequence[tuple[Hashable, Hashable]]) -> float:
    """Return the agreement of two raters on unordered categories: 1 if they always agree, about 0 if by chance.

    Raises:
        StatisticsError: If only one category was used: kappa is then undefined.
    """
    _require_pairs(pairs)
    n = len(pairs)
    observed = sum(left == right for left, right in pairs) / n
    first, second = Counter(left for left, _ in pairs), Counter(right for _, right in pairs)
    chance = sum(first[name] * second[name] for name in first) / (n * n)
    _varied({*first, *second})
    return _chance_corrected(observed, chance)


def gwet_ac1(pairs: Sequence[tuple[Hashable, Hashable]], categories: int = 2) -> float:
    """Return the agreement of two raters by a measure that is robust to a rare category; 1 if they always agree."""
    _require_pairs(pairs)
    used = Counter(name for pair in pairs for name in pair)
    if len(used) > categories or categories < 2:
        raise StatisticsError(
            f"{len(used)} categories were used, {categories} are declared; at least 2 are needed"
        )
    n = len(pairs)
    observed = sum(first == second for first, second in pairs) / n
    shares = [count / (2 * n) for count in used.values()]
    chance = sum(share * (1 - share) for share in shares) / (categories - 1)
    return _chance_corrected(observed, chance)


def krippendorff_alpha(units: Sequence[Sequence[float | None]], metric: Metric = "nominal") -> float:
    """Return the agreement of any number of raters; `units` are trials, each with one rating per rater or None.

    Raises:
        StatisticsError: If no trial has two ratings, or all ratings are equal.
    """
    rated = [[value for value in unit if value is not None] for unit in units]
    rated = [unit for unit in rated if len(unit) > 1]
    if not rated:
        raise StatisticsError("no trial was rated by two people")

    def apart(left: float, right: float) -> float:
        return float(left != right) if metric == "nominal" else (left - right) ** 2

    coincidences: Counter[tuple[float, float]] = Counter()
    for unit in rated:
        for pair in permutations(unit, 2):
            coincidences[pair] += 1 / (len(unit) - 1)  # type: ignore[assignment]
    totals: Counter[float] = Counter()
    for (left, _), weight in coincidences.items():
        totals[left] += weight
    _varied(totals)
    n = sum(totals.values())
    observed = sum(weight * apart(*pair) for pair, weight in coincidences.items()) / n
    expected = sum(
        totals[left] * totals[right] * apart(left, right) for left in totals for right in totals
    ) / (n * (n - 1))
    return 1.0 if observed == 0 else 1 - observed / expected


def _require_pairs(pairs: Sequence[object]) -> None:
    if not pairs:
        raise StatisticsError("no trial was rated by both")


def _varied(used: Collection[object]) -> None:
    if len(used) < 2:
        raise StatisticsError(f"all ratings say {next(iter(used))!r}: how often chance agrees is not defined")


def _chance_corrected(observed: float, chance: float) -> float:
    return 1.0 if observed == 1 else (observed - chance) / (1 - chance)
