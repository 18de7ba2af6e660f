"""Comparison of two arms from the same initial conditions: exact test of discordant pairs, difference over conditions.

Formulae: McNemar's test in its exact binomial form; Gaffke's interval of the conditions' differences, because trials
from the same condition are not independent.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from evaweb.statistics.base import LEVEL, StatisticsError
from evaweb.statistics.bounded import DRAWS, bounded_mean
from evaweb.statistics.difference import Difference


@dataclass(frozen=True, slots=True)
class McNemar:
    """Result of McNemar's test: number of pairs in which only the first arm succeeded, only the second, and p.

    p is the two-sided exact probability.
    """

    first_only: int
    second_only: int
    pairs: int
    p: float


def mcnemar(pairs: Sequence[tuple[bool, bool]]) -> McNemar:
    """Return the exact test of pairs (first succeeded, second succeeded); without discordant pairs p is 1."""
    first = sum(1 for of_first, of_second in pairs if of_first and not of_second)
    second = sum(1 for of_first, of_second in pairs if of_second and not of_first)
    return McNemar(first, second, len(pairs), _binomial(first, second))


def _binomial(first: int, second: int) -> float:
    if first + second == 0:
        return 1.0
    from scipy.stats import binomtest

    return float(binomtest(first, first + second).pvalue)


def over_conditions(
    first: Mapping[Hashable, Sequence[float]],
    second: Mapping[Hashable, Sequence[float]],
    *,
    seed: int,
    level: float = LEVEL,
    draws: int = DRAWS,
) -> Difference:
    """Return the difference of mean outcomes (0 to 1) over initial conditions, which are regarded as a random sample.

    Only conditions that are keys of both `first` and `second` count, each with equal weight.

    Raises:
        StatisticsError: If there are fewer than two such conditions, or one of them has an empty list of outcomes.
    """
    shared = sorted(set(first) & set(second), key=str)
    if len(shared) < 2:
        raise StatisticsError(
            f"{len(shared)} initial conditions that both arms were tried from; at least 2 are needed"
        )
    for name, arm in (("first", first), ("second", second)):
        empty = [key for key in shared if not arm[key]]
        if empty:
            raise StatisticsError(f"the {name} arm has no trial at {empty[0]!r}")
    differences = [fmean(first[key]) - fmean(second[key]) for key in shared]
    mean = bounded_mean({"all": differences}, seed=seed, bounds=(-1.0, 1.0), level=level, draws=draws)
    return Difference(mean.value, mean.interval)
