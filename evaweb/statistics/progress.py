"""Progress within trials: the funnel of milestones, and what scores between 0 and 1 say.

Formula: the posterior of a Dirichlet(1, ..., 1) prior over the levels that a score can have.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from evaweb.statistics.base import LEVEL, Interval, StatisticsError, check_level
from evaweb.statistics.proportions import Proportion, proportion

_DRAWS = 20_000


@dataclass(frozen=True, slots=True)
class Step:
    """One milestone: how many of all trials reached it, and of those that reached the one before."""

    of_all: Proportion
    of_previous: Proportion


def funnel(reached: Sequence[Sequence[bool]]) -> list[Step]:
    """For each milestone, of trials that say of each whether it was reached.

    `of_previous` counts trials that reached the milestone before, whether or not those are ordered.
    """
    if not reached:
        return []
    widths = {len(trial) for trial in reached}
    if len(widths) > 1:
        raise StatisticsError(f"trials with {sorted(widths)} milestones; allowed: the same number in each")
    steps = []
    for i in range(widths.pop()):
        before = [trial for trial in reached if i == 0 or trial[i - 1]]
        steps.append(
            Step(
                proportion(sum(bool(trial[i]) for trial in reached), len(reached)),
                proportion(sum(bool(trial[i]) for trial in before), len(before)),
            )
        )
    return steps


@dataclass(frozen=True, slots=True)
class ScorePosterior:
    """Posterior of a mean score: its expectation, standard deviation and interval."""

    mean: float
    deviation: float
    interval: Interval


def score_posterior(
    counts: Sequence[int], values: Sequence[float], *, seed: int = 0, level: float = LEVEL
) -> ScorePosterior:
    """Of `counts` trials at each of the `values` that a score can have (ascending), equally likely before."""
    check_level(level)
    if len(counts) != len(values) or len(values) < 2:
        raise StatisticsError(
            f"{len(counts)} counts of {len(values)} levels; allowed: as many, and at least 2"
        )
    if any(count < 0 for count in counts):
        raise StatisticsError(f"counts {list(counts)}; allowed: 0 or more")
    import numpy as np

    alpha = np.asarray(counts, dtype=float) + 1
    total, levels = alpha.sum(), np.asarray(values, dtype=float)
    mean = float(alpha @ levels / total)
    variance = float(alpha @ (levels - mean) ** 2 / (total * (total + 1)))
    drawn = np.random.default_rng(seed).dirichlet(alpha, _DRAWS) @ levels
    low, high = np.quantile(drawn, [(1 - level) / 2, (1 + level) / 2])
    return ScorePosterior(mean, math.sqrt(variance), Interval(float(low), float(high), level))
