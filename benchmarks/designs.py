"""Error and power of each design of a comparison, and coverage of the intervals that are shown with it.

The figures are exact for successes and failures, simulated otherwise. Reference values are those that we measured for
STEP (Snyder et al. 2025), a near-optimal sequential test of two policies.
"""

from __future__ import annotations

import hashlib
import json
import math
import operator
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from functools import lru_cache, partial
from itertools import combinations, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks import coverage
from benchmarks.report import Figure, Report
from evaweb.plans.schedule import RANDOM, Condition, Unit, counts_of, schedule
from evaweb.statistics.boundaries import MOST, Boundary, StoppingTable, extremeness_of
from evaweb.statistics.design_power import design_power
from evaweb.statistics.designs import (
    ANYTIME,
    FIXED,
    SCORE,
    design,
    evaluate_design,
    findings,
    in_blocks,
    unbeaten,
)
from evaweb.statistics.difference import barnard
from evaweb.statistics.stagewise import stagewise

SECONDS = coverage.SECONDS
ROOT = Path(__file__).parents[1]
SIZES = (50, 100)  # pairs
ALPHA, LOOSE = 0.05, 0.1
MARGIN = 0.2
_STEPS = 3  # milestones of a trial with partial credit: its score is the share reached
_SOME_RATES = (0.2, 0.5, 0.8)
_RATES = tuple(
    round(0.05 * i, 2) for i in range(1, 20)
)  # rates at which errors of simulated designs are measured
_RUNS_OF_RATES, _SIMULATED = 4000, 0.003  # runs of `courses`, and their standard error at alpha 0.05
_RUNS = 1000
_CHOICES = ((0.5, 0.5, 0.5, 0.5), (0.5, 0.5, 0.5, 0.7), (0.5, 0.5, 0.5, 0.8))  # rates of four checkpoints
_GRID, _ROUNDS = 15, 6  # grid and refinements of the search over drifts
Rates = tuple[float, float]
Courses = list[dict[str, object]]


class Case(NamedTuple):
    """Design of a comparison, without its number of pairs; there is a look after every `every` pairs.

    If `random`, the trials of two checkpoints are in random order, in blocks of two trials at ten conditions.
    """

    rule: str
    alpha: float = ALPHA
    margin: float | None = None
    every: int = 1
    outcome: str = "success"
    random: bool = False


class SimulatedPower(NamedTuple):
    """Power, median number of pairs, and the standard error of the power if it is simulated."""

    power: float
    median: float
    error: float = 0.0


DESIGNS = {
    "fixed": Case(FIXED),
    "late": Case("late"),
    "early": Case("early"),
    "late_in_tens": Case("late", every=10),
    "early_in_tens": Case("early", every=10),
    "fixed_margin": Case(FIXED, margin=MARGIN),
    "late_margin": Case("late", margin=MARGIN),
    "early_margin": Case("early", margin=MARGIN),
    "late_random": Case("late", random=True),
    "early_random": Case("early", random=True),
    "anytime": Case(ANYTIME),
    "fixed_scores": Case(FIXED, outcome=SCORE),
    "anytime_scores": Case(ANYTIME, outcome=SCORE),
}
DRIFTING = {
    **{name: (DESIGNS[name], 50) for name in ("fixed", "late", "early", "late_margin", "early_margin")},
    "early_at_0.1": (Case("early", LOOSE), 30),
    "early_margin_at_0.1": (Case("early", LOOSE, MARGIN), 30),
}
DIFFERENT: tuple[tuple[Rates, int], ...] = (((0.5, 0.7), 50), ((0.5, 0.8), 50), ((0.5, 0.7), 100))
SAME: tuple[tuple[Rates, int], ...] = (
    ((0.7, 0.7), 50),
    ((0.7, 0.7), 100),
)  # equal rates, for designs with a margin
STEP = {((0.5, 0.7), 50): (0.464, 50), ((0.5, 0.8), 50): (0.838, 29), ((0.5, 0.7), 100): (0.780, 68)}


def measure(seconds: float, long: bool = False) -> Report:
    """Measure error and power of the designs, and the coverage of their intervals.

    The names of the figures are `type1.DESIGN.N`, `power.DESIGN.P0.P1.N`, `median_pairs.DESIGN.P0.P1.N`,
    `bias.WHAT.DESIGN.P0.P1.N` and `drift.DESIGN.N`. With `long`, designs of 250 pairs are measured too, and an
    interrupted measurement is continued.
    """
    rows: Courses = []
    store = PartStore() if long else None
    figures: list[Figure] = []
    for name, part in _parts((*SIZES, MOST) if long else SIZES):
        for figure in store.once(name, part, rows) if store else part(rows):
            print(
                f"{figure.name} {figure.value:.4g}", file=sys.stderr, flush=True
            )  # progress, because all figures take minutes
            figures.append(figure)
    covered = coverage.measure(seconds)
    return Report("designs", [*figures, *covered.figures], [*rows, *covered.rows])


Part = Callable[[Courses], Iterator[Figure]]


def _parts(sizes: Sequence[int]) -> Iterator[tuple[str, Part]]:
    looser = [(name, case, n) for name, (case, n) in DRIFTING.items() if name not in DESIGNS]
    for name, case, n in [*((name, case, n) for n in sizes for name, case in DESIGNS.items()), *looser]:
        yield f"type1.{name}.{n}", partial(error_of, name, case, n)
    yield from (("families", families), ("choices", choices), ("powers", powers))
    yield from (("estimates", estimates), ("drifts", drifts))


class PartStore:
    """Store of the completed parts of a long measurement, so that it can be continued.

    Its file is named by a hash of the sources, so that changed sources begin anew.
    """

    def __init__(self) -> None:
        sources = [Path(__file__), *sorted((ROOT / "evaweb" / "statistics").glob("*.py"))]
        made_of = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
        self._file = ROOT / "build" / "benchmarks" / f"designs-{made_of[:16]}.jsonl"
        self._file.parent.mkdir(parents=True, exist_ok=True)
        lines = self._file.read_text().splitlines() if self._file.exists() else []
        self._done: dict[str, dict[str, Any]] = {part["name"]: part for part in map(json.loads, lines)}

    def once(self, name: str, part: Part, rows: Courses) -> list[Figure]:
        """Return the figures of a part, and add its rows to `rows`.

        The figures and rows are computed only if they are not stored yet.
        """
        if name not in self._done:
            own: Courses = []
            figures = [asdict(figure) for figure in part(own)]
            self._done[name] = {"name": name, "figures": figures, "rows": own}
            with self._file.open("a") as file:
                file.write(json.dumps(self._done[name]) + "\n")
        rows += self._done[name]["rows"]
        return [Figure(**figure) for figure in self._done[name]["figures"]]


def error_of(name: str, case: Case, n: int, rows: Courses) -> Iterator[Figure]:
    """Yield the largest probability of a false finding over all success rates that two equal checkpoints may have.

    For designs with an exact boundary the figure is an upper bound, which also holds between the computed rates. For
    other designs the error is simulated at some rates, and may exceed alpha by three standard errors.
    """
    if exact := boundary_of(case, n):
        largest, bound = exact.error()
        rows.append({"type1": name, "pairs": n, "largest": largest, "bound": bound})
        yield Figure(f"type1.{name}.{n}", bound, "", f"<= {case.alpha}")
    else:
        worst = max((_found(case, (rate, rate), n) for rate in _some(case)), key=lambda worst: worst.power)
        rows.append({"type1": name, "pairs": n, "simulated": worst.power, "error": worst.error})
        allowed = case.alpha + 3 * math.sqrt(case.alpha * (1 - case.alpha) / _runs(case))
        yield Figure(f"type1.{name}.{n}", worst.power, "", f"<= {allowed:.4f}")


def powers(rows: Courses) -> Iterator[Figure]:
    """Yield the power of each design, and of scipy's Barnard test for comparison.

    Two designs have requirements. The power of "late" must be at least the power of the design with a fixed number of
    pairs, minus 0.05. The power of "early" must be at least the power of STEP minus 0.02, and its median number of
    pairs may be at most a tenth higher than that of STEP.
    """
    for name, case in DESIGNS.items():
        for rates, n in SAME if case.margin else DIFFERENT:
            characteristics, allowed, soon = _found(case, rates, n), "", ""
            if name == "late":
                allowed = f">= {_found(DESIGNS['fixed'], rates, n).power - 0.05:.4f}"
            if name == "early":
                power, median = STEP[rates, n]
                allowed, soon = f">= {power - 0.02:.4f}", f"<= {1.1 * median:.1f}"
            at = f"{name}.{rates[0]}.{rates[1]}.{n}"
            rows.append({"course": at, **characteristics._asdict()})
            yield Figure(f"power.{at}", characteristics.power, "", allowed)
            yield Figure(f"median_pairs.{at}", characteristics.median, "", soon)
    for rates, n in DIFFERENT:
        yield Figure(f"power.scipy_barnard.{rates[0]}.{rates[1]}.{n}", _of_scipy(rates, n), "")


def estimates(rows: Courses) -> Iterator[Figure]:
    """Yield the bias of the estimated difference, and the coverage of the corrected interval.

    The bias is given for the raw estimate and for the estimate that is corrected for early stopping. Bias and coverage
    are exact: they are sums over every table of results at which the design can end.
    """
    for name in ("late", "early"):
        exact = boundary_of(DESIGNS[name], SIZES[0])
        assert exact is not None
        for rates in ((0.5, 0.5), (0.5, 0.7), (0.5, 0.8)):
            truth, at = rates[0] - rates[1], f"{name}.{rates[0]}.{rates[1]}.{SIZES[0]}"
            raw = corrected = covered = 0.0
            for (a, n, b, m), mass in _ends(exact, rates):
                estimate = stagewise(exact, a, n, b, m)
                raw += mass * (a / n - b / m)
                corrected += mass * estimate.value
                covered += mass * (estimate.interval.low <= truth <= estimate.interval.high)
            rows.append({"estimate": at, "raw": raw, "corrected": corrected, "held": covered})
            yield Figure(f"bias.raw.{at}", raw - truth, "")
            yield Figure(f"bias.corrected.{at}", corrected - truth, "")
            yield Figure(f"coverage.corrected.{at}", covered, "", ">= 0.94")


def _ends(exact: Boundary, rates: Rates) -> Iterator[tuple[tuple[int, int, int, int], float]]:
    """Yield each result with which the design can end, with the probability of that result.

    A result is the number of successes and of trials of the first arm, followed by those of the second arm.
    """
    pairs = exact.looks[-1].first
    alive = np.zeros((pairs + 1, pairs + 1))
    alive[0, 0] = 1.0
    looks = {look.first: region for look, region in zip(exact.looks, exact.regions, strict=True)}
    for pair in range(1, pairs + 1):
        for axis, rate in enumerate(rates):
            alive = alive * (1 - rate) + np.roll(alive * rate, 1, axis=axis)
        reached = alive[: pair + 1, : pair + 1]
        ending = reached > 0 if pair == pairs else looks[pair] & (reached > 0)
        for a, b in np.argwhere(ending):
            yield (int(a), pair, int(b), pair), float(reached[a, b])
        reached[ending] = 0.0


def drifts(rows: Courses) -> Iterator[Figure]:
    """Yield the largest error that was found for rates that change over time, the same rate for both checkpoints.

    It is only reported. The designs assume constant rates; `type1` is the error of the designs under this assumption.
    """
    for name, (case, n) in DRIFTING.items():
        exact = boundary_of(case, n)
        assert exact is not None
        error, knots = worst_drift(exact)
        rows.append({"drift": name, "pairs": n, "error": error, "start, middle, end": knots})
        yield Figure(f"drift.{name}.{n}", error, "")


@lru_cache(maxsize=64)
def boundary_of(case: Case, pairs: int) -> Boundary | None:
    """Return the design's exact boundary; None for an e-process, or for scores.

    Barnard's test is a boundary with one look.
    """
    if case.rule == ANYTIME or case.outcome == SCORE:
        return None
    if case.rule == FIXED and case.margin is None:
        return Boundary((StoppingTable(pairs, pairs, _least(pairs, case.alpha)),), case.alpha)
    looks = range(case.every, pairs, case.every) if case.every > 1 else ()
    counts = counts_of(_in_random_order(pairs), "ab") if case.random else None
    result = design(
        rule=case.rule, blocks=pairs, alpha=case.alpha, margin=case.margin, looks=looks, counts=counts
    )
    return result.boundary


def _in_random_order(blocks: int) -> list[Unit]:
    conditions = [Condition("scene", number) for number in range(10)]
    return schedule(
        checkpoints=["a", "b"],
        conditions=conditions,
        repetitions=blocks // 10,
        key=bytes(32),
        allocation=RANDOM,
    )


def families(rows: Courses) -> Iterator[Figure]:
    """Yield figures of how often equal checkpoints are found to differ when several comparisons are planned.

    A run counts if any of its comparisons is significant. One figure is for a design that drops checkpoints, the others
    are for designs that drop none. The shares are simulated, so a figure may exceed alpha by three standard errors.
    """
    three = ((0, 1), (0, 2), (1, 2))
    allowed = ALPHA + 3 * math.sqrt(ALPHA * (1 - ALPHA) / _RUNS)
    for name, rule, drops in (
        ("all_of_three_fixed", FIXED, False),
        ("all_of_three_early", "early", False),
        ("all_of_three_early_dropped", "early", True),
    ):
        planned = design(rule=rule, blocks=SIZES[0], alpha=ALPHA, comparisons=three, drops=drops, holm=True)
        worst = 0.0
        for rate in _SOME_RATES:
            won = np.random.default_rng(7).random((_RUNS, SIZES[0], 3)) < rate
            ended = (findings(planned, [tuple(enumerate(map(float, block))) for block in run]) for run in won)
            worst = max(
                worst, sum(any(comparison.winner for comparison in outcome.each) for outcome in ended) / _RUNS
            )
        rows.append({"family": name, "blocks": SIZES[0], "simulated": worst})
        yield Figure(f"type1.{name}.{SIZES[0]}", worst, "", f"<= {allowed:.4f}")


def choices(rows: Courses) -> Iterator[Figure]:
    """Yield figures on choosing the best of several checkpoints, either with all trials or with dropping.

    * `best.wrong`: how often a wrong checkpoint is called the best.
    * `best.found`: how often the right checkpoint is called the best.
    * `best.chosen_wrong`: how often the remaining checkpoint with the highest observed rate is not the best one.
    * `best.trials`: median number of trials.

    If several checkpoints share the highest true rate, calling any of them the best is wrong.
    """
    allowed = ALPHA + 3 * math.sqrt(ALPHA * (1 - ALPHA) / _RUNS)
    for rates in _CHOICES:
        arms, best = range(len(rates)), max(rates)
        best_arms = {arm for arm in arms if rates[arm] == best} if rates.count(best) == 1 else set()
        for rule, drops in ((FIXED, False), ("early", True)):
            pairs = tuple(combinations(arms, 2))
            planned = design(
                rule=rule, blocks=SIZES[0], alpha=ALPHA, comparisons=pairs, drops=drops, holm=True
            )
            won = np.random.default_rng(7).random((_RUNS, SIZES[0], len(rates))) < rates
            called, chosen, trials = [], [], []
            for run in won:
                conclusions = findings(planned, [tuple(enumerate(map(float, block))) for block in run])
                left = unbeaten(planned, conclusions)
                trials_of = {arm: conclusions.dropped.get(arm, conclusions.at or SIZES[0]) for arm in arms}
                trials.append(sum(trials_of.values()))
                called.append(left[0] if len(left) == 1 else None)
                chosen.append(max(left, key=lambda arm: run[: trials_of[arm], arm].mean(), default=None))
            wrong = sum(arm is not None and arm not in best_arms for arm in called) / _RUNS
            at = f"{rule}.{'.'.join(map(str, rates))}.{SIZES[0]}"
            said_of = {"wrong": wrong, "trials": float(np.median(trials))}
            if best_arms:
                said_of["found"] = sum(arm in best_arms for arm in called) / _RUNS
                said_of["chosen_wrong"] = sum(arm not in best_arms for arm in chosen) / _RUNS
            for label, value in said_of.items():
                yield Figure(f"best.{label}.{at}", value, "", f"<= {allowed:.4f}" if label == "wrong" else "")
            rows.append({"best": at, **said_of})


def _least(n: int, alpha: float) -> tuple[int, int] | None:
    """Return the least extreme table of results that is significant in Barnard's test; None if there is none.

    The table is given as the numbers of successes of the two checkpoints, each with `n` trials. All more extreme tables
    are significant too.
    """
    tables = sorted(
        ((a, b) for a in range(n + 1) for b in range(a)),
        key=lambda table: operator.truediv(*extremeness_of(table[0], n, table[1], n, None)),
    )
    low, high = 0, len(tables)
    while low < high:
        middle = (low + high) // 2
        a, b = tables[middle]
        low, high = (low, middle) if barnard(a, n, b, n).p <= alpha else (middle + 1, high)
    return tables[low] if low < len(tables) else None


def worst_drift(exact: Boundary) -> tuple[float, tuple[float, ...]]:
    """Search for the drift of success rates with which wrong findings are most probable.

    Return the largest error probability found, and the common rates at start, middle and end with which it occurs. The
    common rate of both checkpoints changes piecewise linearly in time. Each rate is represented by the angle whose
    squared sine is the rate. The search begins with straight lines from a grid of angles, then varies the three angles
    of the best course so far, in ever finer steps.
    """
    angles = np.linspace(0.05, math.pi / 2 - 0.05, _GRID)
    lines = [(start, (start + end) / 2, end) for start, end in product(angles, repeat=2)]
    error, best = _worst(exact, lines)
    step = float(angles[1] - angles[0]) / 2
    for _ in range(_ROUNDS):
        around = product((-step, 0.0, step), repeat=3)
        near = [tuple(float(a + m) for a, m in zip(best, moved, strict=True)) for moved in around]
        error, best = max((error, best), _worst(exact, near))
        step *= 0.7
    return error, tuple(round(math.sin(angle) ** 2, 4) for angle in best)


def _worst(exact: Boundary, knots: Sequence[tuple[float, ...]]) -> tuple[float, tuple[float, ...]]:
    pairs = exact.looks[-1].first
    places = np.linspace(0, 2, pairs)
    rates = np.array([np.interp(places, range(3), np.sin(angles) ** 2) for angles in knots])
    errors = errors_at(exact, rates)
    at = int(errors.argmax())
    return float(errors[at]), knots[at]


def errors_at(exact: Boundary, rates: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the probability that a comparison stops, for each course of success rates: float64 [courses].

    `rates` [courses, pairs] is the success rate that both checkpoints have at each pair of trials. If the design has a
    margin, the second checkpoint's rate is (1 - margin) times the given rate, and the first checkpoint's rate is the
    second's plus the margin.
    """
    margin = exact.margin or 0.0
    pairs = exact.looks[-1].first
    alive, stopped = np.zeros((len(rates), pairs + 1, pairs + 1)), np.zeros(len(rates))
    alive[:, 0, 0] = 1.0
    looks = {look.first: region for look, region in zip(exact.looks, exact.regions, strict=True)}
    for pair in range(1, pairs + 1):
        common = (1 - margin) * rates[:, pair - 1, None, None]
        for axis, rate in ((1, margin + common), (2, common)):
            alive = alive * (1 - rate) + np.roll(alive * rate, 1, axis=axis)  # the last entry is still empty
        if pair in looks:
            region = looks[pair]
            reached = alive[:, : pair + 1, : pair + 1]
            stopped += reached[:, region].sum(axis=1)
            reached[:, region] = 0.0
    return stopped


def _some(case: Case) -> tuple[float, ...]:
    return _RATES if case.outcome != SCORE else _RATES[1::4]


def _runs(case: Case) -> int:
    return _RUNS if case.outcome == SCORE else _RUNS_OF_RATES


@lru_cache(maxsize=256)
def _found(case: Case, rates: Rates, pairs: int) -> SimulatedPower:
    """Return power and median number of pairs at these rates, exact if possible."""
    if exact := boundary_of(case, pairs):
        ended = exact.operating_characteristics(*rates)
        return SimulatedPower(ended.power, ended.median // 2)
    if case.outcome == SCORE:
        return _simulated(case, rates, pairs)
    of_runs = design_power(case.rule, pairs, *rates, case.alpha)
    return SimulatedPower(of_runs.power, of_runs.median, _error(of_runs.power, _RUNS_OF_RATES))


def _simulated(case: Case, rates: Rates, pairs: int) -> SimulatedPower:
    """Return power and median number of pairs for scores that are shares of milestones.

    Each milestone is reached with the probability in `rates`.
    """
    chance = np.random.default_rng(pairs)
    planned = design(rule=case.rule, blocks=pairs, alpha=case.alpha, outcome=case.outcome)
    scores = chance.binomial(_STEPS, rates, size=(_RUNS, pairs, 2)) / _STEPS
    ended = [
        evaluate_design(planned, in_blocks([(left, right) for left, right in run])) for run in scores.tolist()
    ]
    power = sum(outcome.winner is not None for outcome in ended) / _RUNS
    return SimulatedPower(
        power, float(np.median([outcome.ended_at_pair or pairs for outcome in ended])), _error(power, _RUNS)
    )


def _error(share: float, runs: int) -> float:
    return math.sqrt(share * (1 - share) / runs)


def _of_scipy(rates: Rates, n: int) -> float:
    """Return the power of scipy's test for samples of size `n`, by enumeration of all tables of results.

    The test is applied to only one of several tables that are equal by symmetry.
    """
    from scipy.stats import barnard_exact, binom

    first, second = (binom.pmf(np.arange(n + 1), n, rate) for rate in rates)
    power = 0.0
    for a in range(n + 1):
        for b in range(min(a, n - a + 1)):
            if barnard_exact([[a, b], [n - a, n - b]]).pvalue <= ALPHA:
                alike = {(a, b), (b, a), (n - a, n - b), (n - b, n - a)}
                power += sum(float(first[left] * second[right]) for left, right in alike)
    return power
