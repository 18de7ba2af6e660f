"""How often the 95 % intervals of means hold the true mean, from the fewest trials on and with lopsided outcomes."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Figure, Report
from evaweb.statistics.bounded import bounded_mean
from evaweb.statistics.paired import over_conditions

SECONDS = 10.0
_WANTED = ">= 0.93"
_SIZES = (2, 5, 10, 20, 50)
_RUNS_PER_SECOND = 100  # asked for, so that the same seconds give the same figures on any machine
_DRAWS = 1000
Chance = np.random.Generator


class Case(NamedTuple):
    """A way in which outcomes come about: does the interval of `n` of them hold the mean, and from which n on it is."""

    holds: Callable[[Chance, int, int], bool]
    fewest: int = 1


def measure(seconds: float) -> Report:
    """`coverage.NAME.N`: the share of runs whose interval holds the truth, of N trials (each scene) or conditions."""
    figures, rows, runs = [], [], max(1, round(_RUNS_PER_SECOND * seconds))
    for name, case in CASES.items():
        for n in sorted({case.fewest, *(size for size in _SIZES if size > case.fewest)}):
            share = covered(case, n, runs=runs, draws=_DRAWS)
            figures.append(Figure(f"coverage.{name}.{n}", share, "", _WANTED))
            rows.append({"name": name, "n": n, "runs": runs, "coverage": share})
    return Report("coverage", figures, rows)


def covered(case: Case, n: int, *, runs: int, draws: int) -> float:
    """The share of `runs` whose interval holds the truth."""
    chance = np.random.default_rng(n)
    return sum(case.holds(chance, n, draws) for _ in range(runs)) / runs


def _mean(truth: float, draw: Callable[[Chance, int], NDArray[np.float64]]) -> Case:
    """Scores of one checkpoint."""

    def holds(chance: Chance, n: int, draws: int) -> bool:
        outcomes = draw(chance, n).tolist()
        return bounded_mean({"all": outcomes}, seed=_seed(chance), draws=draws).interval.holds(truth)

    return Case(holds)


def _scenes(*rates: float) -> Case:
    """Successes over scenes, so many trials in each."""

    def holds(chance: Chance, n: int, draws: int) -> bool:
        scenes = {str(i): (chance.random(n) < rate).tolist() for i, rate in enumerate(rates)}
        found = bounded_mean(scenes, seed=_seed(chance), draws=draws)
        return found.interval.holds(float(np.mean(rates)))

    return Case(holds)


def _conditions(first: float, second: float, spread: float, trials: int) -> Case:
    """Successes of two checkpoints from conditions in which the first one's rate differs by up to `spread`."""

    def holds(chance: Chance, n: int, draws: int) -> bool:
        rates = first + spread * chance.uniform(-1, 1, n)
        one = {i: (chance.random(trials) < rate).tolist() for i, rate in enumerate(rates)}
        other = {i: (chance.random(trials) < second).tolist() for i in range(n)}
        found = over_conditions(one, other, seed=_seed(chance), draws=draws)
        return found.interval.holds(first - second)

    return Case(holds, fewest=2)


def _seed(chance: Chance) -> int:
    return int(chance.integers(2**32))


CASES = {
    "score_successes": _mean(0.9, lambda chance, n: (chance.random(n) < 0.9).astype(float)),
    "score_thirds": _mean(0.5, lambda chance, n: chance.integers(0, 4, n) / 3),
    "score_skewed": _mean(0.3 / 3.3, lambda chance, n: chance.beta(0.3, 3, n)),
    "score_rare": _mean(0.075, lambda chance, n: chance.choice([0.0, 0.5, 1.0], n, p=[0.9, 0.05, 0.05])),
    "three_scenes": _scenes(0.9, 0.6, 0.3),
    "ten_scenes": _scenes(*[0.9] * 10),
    "conditions": _conditions(0.7, 0.5, 0.3, 1),
    "conditions_of_three": _conditions(0.9, 0.8, 0.1, 3),
}
