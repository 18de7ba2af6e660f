"""Complete analysis of an evaluation, computed once from its outcomes; pages, exports and reports only display it.

The methods are those of docs/evaluation.md. A value that cannot be computed is None, with the reason in `notes`.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

from evaweb.results.analysis.arm import Arm, ArmTrials
from evaweb.results.analysis.comparison import ComparedTrials, Comparison, Standing, Verdict, compare
from evaweb.results.analysis.json_forms import write_interval
from evaweb.results.analysis.outcomes import (
    Interruption,
    Outcome,
    TimeHorizon,
    by_checkpoint,
    count_successes,
)
from evaweb.results.analysis.statistic import compute_all
from evaweb.statistics.difference import barnard
from evaweb.statistics.means import Average, average
from evaweb.statistics.multiple_comparisons import holm, letters


@dataclass(frozen=True, slots=True)
class Recipe:
    """Training recipe with several training runs: the success rate of each run, and their mean.

    The mean's interval treats the runs as the sample, not their trials, because it has to cover what another training
    run would achieve. With fewer than three runs there is no interval.
    """

    name: str
    rates: dict[str, float]
    mean: Average


@dataclass(frozen=True, slots=True)
class Analysis:
    """Analysis of an evaluation.

    Attributes:
        n: Number of trials that count.
        arms: Results of each checkpoint, the best first.
        comparisons: All comparisons of two checkpoints.
        letters: Letters of each checkpoint. Checkpoints that share a letter were not found to differ.
        alpha: Error probability of all comparisons together.
        notes: Remarks on the analysis.
        recipes: Training recipes with several training runs.
    """

    n: int
    arms: tuple[Arm, ...]
    comparisons: tuple[Comparison, ...]
    letters: dict[str, str]
    alpha: float
    notes: tuple[str, ...]
    recipes: tuple[Recipe, ...] = ()

    def arm(self, checkpoint: str) -> Arm:
        """Return the arm of a checkpoint."""
        return next(arm for arm in self.arms if arm.checkpoint == checkpoint)

    def comparison_of(self, first: str, second: str) -> Comparison | None:
        """Return the comparison of two checkpoints in either order, or None."""
        return next((c for c in self.comparisons if {c.first, c.second} == {first, second}), None)

    @property
    def document(self) -> dict[str, Any]:
        """Analysis as JSON."""
        return {
            "n": self.n,
            "alpha": self.alpha,
            "letters": dict(self.letters),
            "arms": {arm.checkpoint: arm.document for arm in self.arms},
            "comparisons": [comparison.document for comparison in self.comparisons],
            "recipes": {
                recipe.name: {
                    "rates": recipe.rates,
                    "runs": recipe.mean.n,
                    "mean": recipe.mean.value,
                    "student": write_interval(recipe.mean.interval),
                }
                for recipe in self.recipes
            },
        }


def analyse(
    outcomes: Sequence[Outcome],
    interruptions: Sequence[Interruption] = (),
    *,
    alpha: float = 0.05,
    planned: Mapping[tuple[str, str], Verdict] | None = None,
    in_pairs: bool = True,
    limits: Mapping[str, float] | None = None,
    checkpoints: Sequence[str] = (),
    whole: bool = False,
    recipes: Mapping[str, str] | None = None,
) -> Analysis:
    """Return the complete analysis of these outcomes.

    Only the design decides planned comparisons: checkpoints that it separated share no letter. While a
    comparison is undecided, it has neither letters nor anything else that could pass for a decision.

    Args:
        outcomes: Trials that count.
        interruptions: Interrupted runs; they are used only for the rate of interventions.
        alpha: Error probability of all comparisons together.
        planned: The design's verdict on each planned comparison (first, second). Planned comparisons keep this order;
            in any other the checkpoint with the higher success rate is the first.
        in_pairs: False for random order: a block then has trials of the checkpoints that were drawn, and there are no
            pairs.
        limits: Time limits [s] of the scenes that have one. The smallest is the horizon of times to success; without
            any limit the horizon is the duration of the longest run.
        checkpoints: All checkpoints of the evaluation in the order of their colours, including those without a trial in
            `outcomes`.
        whole: Whether these are all trials of a plan, with blocks numbered from 0. Evidence then ends before the first
            incomplete block, as in the plan's design: otherwise the choice of the next trial could influence it.
        recipes: Name of the training recipe by checkpoint, for the checkpoints that are training runs of one.
    """
    by_design = planned or {}
    arms, timing = by_checkpoint(outcomes), TimeHorizon.of(outcomes, limits or {})
    series = list(dict.fromkeys([*checkpoints, *sorted(arms)]))
    counts = {name: count_successes(trials) for name, trials in arms.items()}
    ranked = sorted(arms, key=lambda name: (-counts[name][0] / counts[name][1], name))
    couples = [_directed(couple, by_design) for couple in combinations(ranked, 2)]
    tests = [barnard(*counts[first], *counts[second]) for first, second in couples]
    corrected = holm([test.p for test in tests])
    comparisons = tuple(
        compare(
            couple,
            ComparedTrials(
                *(arms[name] for name in couple),
                test,
                p,
                _share(alpha, couples, by_design, couple),
                timing,
                in_pairs,
                whole,
            ),
            by_design.get(couple),
        )
        for couple, test, p in zip(couples, tests, corrected, strict=True)
    )
    apart = {frozenset((c.first, c.second)) for c in comparisons if _apart(c, by_design, alpha)}
    all_decided = all(by_design[c.first, c.second].apart is not None for c in comparisons if _is_planned(c))
    return Analysis(
        len(outcomes),
        tuple(
            Arm(
                name,
                **compute_all(
                    Arm, ArmTrials(arms[name], [i for i in interruptions if i.checkpoint == name], timing)
                ),
                series=series.index(name),
            )
            for name in ranked
        ),
        comparisons,
        letters(ranked, apart) if all_decided else {},
        alpha,
        tuple(_imbalances(arms)),
        tuple(_recipes(arms, recipes or {})),
    )


_FEWEST_RUNS = 3  # runs of a recipe for an interval


def _recipes(arms: Mapping[str, Sequence[Outcome]], recipes: Mapping[str, str]) -> Iterator[Recipe]:
    """Yield the success rates of each training recipe of which at least two checkpoints have trials.

    `arms` are the trials by checkpoint, `recipes` the recipes by checkpoint; each checkpoint is one training run of its
    recipe.
    """
    runs: dict[str, dict[str, float]] = defaultdict(dict)
    for name in sorted(arms):
        if recipes.get(name):
            successes, n = count_successes(arms[name])
            runs[recipes[name]][name] = successes / n
    for recipe, rates in sorted(runs.items()):
        mean = average(list(rates.values()))
        if len(rates) > 1 and mean is not None:
            yield Recipe(recipe, rates, mean if len(rates) >= _FEWEST_RUNS else replace(mean, interval=None))


def _is_planned(comparison: Comparison) -> bool:
    return comparison.standing is not Standing.UNPLANNED


def _apart(comparison: Comparison, by_design: Mapping[tuple[str, str], Verdict], alpha: float) -> bool:
    if _is_planned(comparison):
        return bool(by_design[comparison.first, comparison.second].apart)
    return comparison.corrected is not None and comparison.corrected <= alpha


def _directed(couple: tuple[str, str], planned: Iterable[tuple[str, str]]) -> tuple[str, str]:
    return next((pair for pair in planned if set(pair) == set(couple)), couple)


def _share(
    alpha: float,
    couples: Sequence[tuple[str, str]],
    planned: Collection[tuple[str, str]],
    couple: tuple[str, str],
) -> float:
    """Return alpha of one comparison.

    Planned comparisons share alpha equally. For any other comparison it is divided by the number of all comparisons.
    """
    return alpha / (len(planned) if couple in planned else len(couples))


def _imbalances(arms: dict[str, list[Outcome]]) -> list[str]:
    """Return notes on initial conditions that were not tried equally often: pooled rates are then misleading."""
    cells = {name: Counter(o.condition for o in trials) for name, trials in arms.items()}
    every = sorted({condition for counts in cells.values() for condition in counts})
    uneven = [key for key in every if len({counts[key] for counts in cells.values()}) > 1]
    if not uneven:
        return []
    return [
        f"{len(uneven)} of {len(every)} initial conditions were not tried equally often with all checkpoints "
        f"({uneven[0]} and others)"
        if len(uneven) > 1
        else f"{uneven[0]} was not tried equally often with all checkpoints"
    ]
