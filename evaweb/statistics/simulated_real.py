"""Comparison of simulated and real evaluations of the same checkpoints.

Agreement of the rankings: Spearman's rank correlation (1904), and the mean maximum rank violation of SIMPLER (Li et
al. 2024), the real difference that is lost if simulation reverses the order of two checkpoints. Gain from many
simulated trials added to a few real ones: prediction-powered inference (Angelopoulos et al. 2023) with the weight of
simulation that makes the interval narrowest (PPI++, 2023); the weight is 0 if the two are unrelated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

from evaweb.statistics.base import LEVEL, Interval, StatisticsError, check_level
from evaweb.statistics.difference import Difference

Pair = tuple[float, float]  # real and simulated outcome of the same checkpoint under the same condition
_FEWEST = 8  # fewest pairs per arm for an interval by the normal approximation
_FEWEST_OF_EACH = 5  # fewest real successes and failures: near 0 and 1 the interval would be far too narrow


@dataclass(frozen=True, slots=True)
class Powered:
    """Outcomes of one arm (0 to 1), real and simulated.

    `paired` has each real outcome with the simulated outcome that belongs to it. `beside` has the further simulated
    outcomes.
    """

    paired: Sequence[Pair]
    beside: Sequence[float]


def rank_correlation(simulated: Sequence[float], real: Sequence[float]) -> float | None:
    """Return Spearman's rank correlation with averaged ties; None for fewer than two values or if one side is
    constant.
    """
    _check(simulated, real)
    simulated_ranks, real_ranks = _ranks(simulated), _ranks(real)
    if len(simulated_ranks) < 2:
        return None
    spread = _covariance(simulated_ranks, simulated_ranks) * _covariance(real_ranks, real_ranks)
    return _covariance(simulated_ranks, real_ranks) / math.sqrt(spread) if spread > 0 else None


def rank_violation(simulated: Sequence[float], real: Sequence[float]) -> float:
    """Return the mean rank violation over the checkpoints.

    Two checkpoints violate the ranking if their order in simulation is not their order in reality. The violation of a
    checkpoint is the largest difference of real values between this checkpoint and any with which it violates the
    ranking; 0 if there is no such checkpoint.
    """
    _check(simulated, real)
    numbers = range(len(real))
    worst = [
        max(
            (
                abs(real[i] - real[j])
                for j in numbers
                if (simulated[i] < simulated[j]) != (real[i] < real[j]) and real[i] != real[j]
            ),
            default=0.0,
        )
        for i in numbers
    ]
    return math.fsum(worst) / len(worst) if worst else 0.0


def powered_difference(first: Powered, second: Powered, level: float = LEVEL) -> Difference | None:
    """Return the first arm's real rate minus the second's, estimated with the help of simulation.

    None if an arm has fewer than eight pairs, or fewer than five real successes or failures.
    """
    check_level(level)
    for arm in (first, second):
        won = math.fsum(real for real, _ in arm.paired)
        if len(arm.paired) < _FEWEST or min(won, len(arm.paired) - won) < _FEWEST_OF_EACH:
            return None
    (mean_first, spread_first), (mean_second, spread_second) = _powered(first), _powered(second)
    half = NormalDist().inv_cdf(0.5 + level / 2) * math.sqrt(spread_first + spread_second)
    value = mean_first - mean_second
    return Difference(value, Interval(max(-1.0, value - half), min(1.0, value + half), level))


def _powered(arm: Powered) -> tuple[float, float]:
    """Return the estimated mean and its variance."""
    real, matched = ([pair[side] for pair in arm.paired] for side in (0, 1))
    n, extra = len(real), list(arm.beside)
    if len(extra) < 2:
        return math.fsum(real) / n, _covariance(real, real) / (n - 1) / n
    whole = [*matched, *extra]
    spread = _covariance(whole, whole) / (len(whole) - 1)
    weight = 0.0
    if spread > 0:
        weight = _covariance(real, matched) / (n - 1) / (spread * (1 + n / len(extra)))
        weight = min(max(weight, 0.0), 1.0)
    left = [real_value - weight * simulated_value for real_value, simulated_value in arm.paired]
    mean = math.fsum(left) / n + weight * math.fsum(extra) / len(extra)
    variance = _covariance(left, left) / (n - 1) / n
    return mean, variance + weight**2 * _covariance(extra, extra) / (len(extra) - 1) / len(extra)


def _covariance(first: Sequence[float], second: Sequence[float]) -> float:
    """Return the sum over all pairs of the product of both values' deviations from their means.

    It is not divided by the number of pairs.
    """
    mean_first, mean_second = math.fsum(first) / len(first), math.fsum(second) / len(second)
    return math.fsum((a - mean_first) * (b - mean_second) for a, b in zip(first, second, strict=True))


def _ranks(values: Sequence[float]) -> list[float]:
    return [
        (sum(compared < value for compared in values) + sum(compared <= value for compared in values) + 1) / 2
        for value in values
    ]


def _check(simulated: Sequence[float], real: Sequence[float]) -> None:
    if len(simulated) != len(real):
        raise StatisticsError(f"{len(simulated)} simulated rates and {len(real)} real ones; allowed: as many")
