"""Coverage of the displayed 95 % intervals, from the smallest number of trials on, and for skewed outcomes."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Figure, Report
from evaweb.statistics.base import Interval
from evaweb.statistics.bounded import bounded_mean
from evaweb.statistics.confidence_sequence import confidence_sequence
from evaweb.statistics.difference import newcombe
from evaweb.statistics.means import average
from evaweb.statistics.paired import over_conditions
from evaweb.statistics.preference import Comparison, NotIdentifiedError, preferences
from evaweb.statistics.proportions import clopper_pearson, posterior, wilson
from evaweb.statistics.rates import rate

SECONDS = 10.0
_WANTED = ">= 0.93"
_SIZES = (2, 5, 10, 20, 50)
_RUNS_PER_SECOND = 100  # fixed, so that equal seconds give equal figures on any machine
_DRAWS = 1000
Chance = np.random.Generator


class Case(NamedTuple):
    """Kind of outcomes for which the coverage of an interval is measured.

    `holds` generates `n` outcomes and returns whether their interval contains the truth. `fewest` is the smallest n
    with an interval, and `wanted` the requirement, "" if the coverage is only reported.
    """

    holds: Callable[[Chance, int, int], bool]
    fewest: int = 1
    wanted: str = _WANTED


def measure(seconds: float) -> Report:
    """Measure `coverage.NAME.N`: the share of runs whose interval contains the true value.

    N is the number of trials (per scene), conditions or pairs; for rates per hour it is the expected number of events.
    """
    figures, rows, runs = [], [], max(1, round(_RUNS_PER_SECOND * seconds))
    for name, case in CASES.items():
        for n in sorted({case.fewest, *(size for size in _SIZES if size > case.fewest)}):
            share = covered(case, n, runs=runs, draws=_DRAWS)
            figures.append(Figure(f"coverage.{name}.{n}", share, "", case.wanted))
            rows.append({"name": name, "n": n, "runs": runs, "coverage": share})
    return Report("coverage", figures, rows)


def covered(case: Case, n: int, *, runs: int, draws: int) -> float:
    """Return the share of `runs` simulated runs in which the interval contains the true value.

    Each run has `n` outcomes; `draws` is passed on to the computation of the interval.
    """
    chance = np.random.default_rng(n)
    return sum(case.holds(chance, n, draws) for _ in range(runs)) / runs


def _mean(truth: float, draw: Callable[[Chance, int], NDArray[np.float64]]) -> Case:
    """Return the case in which the mean score of one checkpoint is estimated.

    `draw` generates the scores, whose true mean is `truth`.
    """

    def holds(chance: Chance, n: int, draws: int) -> bool:
        outcomes = draw(chance, n).tolist()
        return bounded_mean({"all": outcomes}, seed=_seed(chance), draws=draws).interval.holds(truth)

    return Case(holds)


def _scenes(*rates: float) -> Case:
    """Return the case of the success rate over several scenes, with n trials in each.

    `rates` are the true success rates of the scenes.
    """

    def holds(chance: Chance, n: int, draws: int) -> bool:
        scenes = {str(i): (chance.random(n) < rate).tolist() for i, rate in enumerate(rates)}
        estimate = bounded_mean(scenes, seed=_seed(chance), draws=draws)
        return estimate.interval.holds(float(np.mean(rates)))

    return Case(holds)


def _conditions(first: float, second: float, spread: float, trials: int) -> Case:
    """Return the case of the difference between two checkpoints, measured under n conditions with `trials` trials each.

    The second checkpoint has the success rate `second` under every condition. The first checkpoint's rate differs from
    condition to condition: it is `first` plus or minus at most `spread`.
    """

    def holds(chance: Chance, n: int, draws: int) -> bool:
        rates = first + spread * chance.uniform(-1, 1, n)
        left: dict[Hashable, list[float]] = {
            i: (chance.random(trials) < rate).tolist() for i, rate in enumerate(rates)
        }
        right: dict[Hashable, list[float]] = {i: (chance.random(trials) < second).tolist() for i in range(n)}
        estimate = over_conditions(left, right, seed=_seed(chance), draws=draws)
        return estimate.interval.holds(first - second)

    return Case(holds, fewest=2)


def _rate_of_two(interval: Callable[[int, int, int, int], Interval]) -> Case:
    """Return the case of `interval` for the difference between the success rates of two checkpoints.

    In each run the two rates are drawn uniformly from 0 to 1.
    """

    def holds(chance: Chance, n: int, draws: int) -> bool:
        rates = chance.random(2)
        first, second = chance.binomial(n, rates).tolist()
        return interval(first, n, second, n).holds(rates[0] - rates[1])

    return Case(holds)


def _rate(
    interval: Callable[[int, int], Interval | None], fixed: float | None = None, allowed: str = _WANTED
) -> Case:
    """Return the case in which the success rate of one checkpoint is estimated by `interval`.

    The true rate is `fixed`, or drawn uniformly from 0 to 1 if `fixed` is None. `allowed` is the requirement on the
    coverage, "" if the coverage is only reported.
    """

    def holds(chance: Chance, n: int, draws: int) -> bool:
        truth = chance.random() if fixed is None else fixed
        estimated = interval(int(chance.binomial(n, truth)), n)
        return estimated is not None and estimated.holds(truth)

    return Case(holds, wanted=allowed)


def _per_hour(chance: Chance, n: int, draws: int) -> bool:
    return rate(int(chance.poisson(n)), 3600.0).interval.holds(n)


def _student(draw: Callable[[Chance, int], NDArray[np.float64]], truth: float, allowed: str) -> Case:
    """Return the case of the interval for the mean of one number per trial.

    `draw` generates the numbers, whose true mean is `truth`. `allowed` is the required coverage.
    """

    def holds(chance: Chance, n: int, draws: int) -> bool:
        estimate = average(draw(chance, n).tolist())
        return estimate is not None and estimate.interval is not None and estimate.interval.holds(truth)

    return Case(holds, fewest=2, wanted=allowed)


def _anytime(first: float, second: float) -> Case:
    """Return the case in which two checkpoints are compared by the successes in pairs of trials.

    `first` and `second` are the success rates of the checkpoints. The interval of this case has to contain the true
    difference after every pair, because what the interval once excludes stays excluded.
    """

    def holds(chance: Chance, n: int, draws: int) -> bool:
        left, right = (chance.random((2, n)) < [[first], [second]]).astype(float)
        sequence = confidence_sequence((left - right).tolist())
        return sequence is not None and sequence.holds(first - second)

    return Case(holds)


def _preferred(chance: Chance, n: int, draws: int) -> bool:
    """Return True if the interval contains the truth for comparisons of two checkpoints, or if there is no interval.

    The worth of one checkpoint is e times that of the other.
    """
    weights = np.array([math.e, math.exp(0.5), 1.0])  # Davidson's weights with frequent ties
    preferred = chance.choice(["first", "tie", "second"], n, p=weights / weights.sum()).tolist()
    turned: dict[str, Any] = {"first": "second", "tie": "tie", "second": "first"}
    rows = [
        Comparison("a", "b", word) if i % 2 else Comparison("b", "a", turned[word])
        for i, word in enumerate(preferred)
    ]
    try:
        result = preferences(rows, order_effect=True)
    except NotIdentifiedError:
        return True
    return result.contrasts["a", "b"].interval.holds(1.0)


def _seed(chance: Chance) -> int:
    return int(chance.integers(2**32))


CASES = {
    "wilson": _rate(wilson),
    "wilson_at_0.1": _rate(wilson, 0.1, ""),
    "clopper_pearson": _rate(clopper_pearson),
    "clopper_pearson_at_0.1": _rate(clopper_pearson, 0.1),
    "posterior": _rate(lambda x, n: posterior(x, n).interval()),
    "newcombe": _rate_of_two(lambda *counts: newcombe(*counts).interval),
    "garwood": Case(_per_hour),
    "student_normal": _student(lambda chance, n: chance.normal(size=n), 0.0, _WANTED),
    "student_skewed": _student(lambda chance, n: chance.exponential(size=n), 1.0, ""),
    "preference": Case(_preferred, fewest=5),
    "anytime": _anytime(0.8, 0.5),
    "anytime_same": _anytime(0.95, 0.95),
    "score_successes": _mean(0.9, lambda chance, n: (chance.random(n) < 0.9).astype(float)),
    "score_thirds": _mean(0.5, lambda chance, n: chance.integers(0, 4, n) / 3),
    "score_skewed": _mean(0.3 / 3.3, lambda chance, n: chance.beta(0.3, 3, n)),
    "score_rare": _mean(0.075, lambda chance, n: chance.choice([0.0, 0.5, 1.0], n, p=[0.9, 0.05, 0.05])),
    "three_scenes": _scenes(0.9, 0.6, 0.3),
    "ten_scenes": _scenes(*[0.9] * 10),
    "conditions": _conditions(0.7, 0.5, 0.3, 1),
    "conditions_of_three": _conditions(0.9, 0.8, 0.1, 3),
}
