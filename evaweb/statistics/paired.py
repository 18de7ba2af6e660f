"""Two arms tried from the same initial conditions: the exact test of discordant pairs, bootstrap over conditions.

Formulae: McNemar's test in its exact binomial form; cluster bootstrap (Davison and Hinkley 1997, 3.8), whose units are
initial conditions, because trials from one of them are not independent of each other.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

from evaweb.statistics.base import LEVEL, Interval, StatisticsError, check_level
from evaweb.statistics.difference import Difference

DRAWS = 10_000


@dataclass(frozen=True, slots=True)
class McNemar:
    """Pairs in which only the first, and only the second, succeeded; the two-sided exact probability."""

    first_only: int
    second_only: int
    pairs: int
    p: float


def mcnemar(pairs: Sequence[tuple[bool, bool]]) -> McNemar:
    """The exact test of pairs (first succeeded, second succeeded); without discordant pairs p is 1."""
    first = sum(1 for one, other in pairs if one and not other)
    second = sum(1 for one, other in pairs if other and not one)
    return McNemar(first, second, len(pairs), _binomial(first, second))


def _binomial(first: int, second: int) -> float:
    if first + second == 0:
        return 1.0
    from scipy.stats import binomtest

    return float(binomtest(first, first + second).pvalue)


def cluster_bootstrap(
    first: Mapping[Hashable, Sequence[float]],
    second: Mapping[Hashable, Sequence[float]],
    *,
    seed: int,
    level: float = LEVEL,
    draws: int = DRAWS,
) -> Difference:
    """Difference of the means of both arms' outcomes, by initial condition; the interval resamples conditions.

    Only conditions that both arms were tried from count, each as heavy as any other. At least two are needed, and
    outcomes that differ somewhere: where every condition says the same, a bootstrap would claim to know without doubt.
    """
    check_level(level)
    import numpy as np

    shared = sorted(set(first) & set(second), key=str)
    if len(shared) < 2:
        raise StatisticsError(
            f"{len(shared)} initial conditions that both arms were tried from; at least 2 are needed"
        )
    for name, arm in (("first", first), ("second", second)):
        empty = [key for key in shared if not arm[key]]
        if empty:
            raise StatisticsError(f"the {name} arm has no trial at {empty[0]!r}")
    differences = np.array([np.mean(first[key]) - np.mean(second[key]) for key in shared])
    if np.ptp(differences) == 0:
        raise StatisticsError(
            f"all {len(shared)} initial conditions differ by the same {differences[0]:g}: nothing to resample"
        )
    drawn = np.random.default_rng(seed).integers(0, len(shared), (draws, len(shared)))
    means = differences[drawn].mean(axis=1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return Difference(float(differences.mean()), Interval(float(low), float(high), level))
