"""Complete analysis of an evaluation, computed once from its outcomes; pages, exports and reports only display it.

The methods are those of docs/evaluation.md. A value that cannot be computed is None, with the reason in `notes`.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import combinations
from typing import TypeVar

from evaweb.results.analysis.outcomes import (
    Interruption,
    Outcome,
    Pair,
    by_checkpoint,
    pair_by_block,
    unbroken,
)
from evaweb.statistics.base import LEVEL, Interval, StatisticsError
from evaweb.statistics.bounded import BoundedMean, bounded_mean
from evaweb.statistics.confidence_sequence import confidence_sequence
from evaweb.statistics.difference import Difference, ExactTest, barnard, newcombe, probability_better
from evaweb.statistics.means import Average, average
from evaweb.statistics.milestone_funnel import FunnelStep, funnel
from evaweb.statistics.multiple_comparisons import holm, letters
from evaweb.statistics.paired import McNemar, mcnemar, over_conditions
from evaweb.statistics.permutation import SignFlipTest, sign_flip_test
from evaweb.statistics.proportions import Posterior, Proportion, clopper_pearson, posterior, proportion
from evaweb.statistics.rates import Rate, rate
from evaweb.statistics.sequential import Evidence, score_evidence, success_evidence
from evaweb.statistics.stratified import Stratified, StratumTable, exact_within, interaction, mantel_haenszel
from evaweb.statistics.success_times import Curve, RestrictedMean, cumulative_incidence, restricted_mean
from evaweb.trials.failure_text import UNSPECIFIED, failure_text

SEED = 20_260  # seed of all random draws: equal data give equal intervals
_RANDOM = "checkpoints came in random order: there are no pairs"
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Funnel:
    """Milestone funnel of one scene, with the text of each milestone."""

    scene: str
    labels: tuple[str, ...]
    steps: tuple[FunnelStep, ...]


@dataclass(frozen=True, slots=True)
class FailureMode:
    """Phase and cause of failure ("" if unspecified) of `count` out of `n` trials, with the exact interval of the
    share.

    The interval is valid for a single mode named beforehand; for the most frequent of many it is too optimistic.
    """

    phase: str
    cause: str
    count: int
    n: int
    interval: Interval

    @property
    def words(self) -> str:
        """Text for display."""
        return failure_text(self.phase, self.cause) or UNSPECIFIED


@dataclass(frozen=True, slots=True)
class Arm:
    """Results of one checkpoint.

    Attributes:
        exact: Clopper-Pearson interval of the success rate.
        macro: Mean of the scenes' success rates, with equal weights.
        cells: Success by initial condition.
        curve: Cumulative successes over time [s], up to one horizon for all arms; a failed trial has not succeeded
            by then.
        mean_time: Restricted mean time to success [s] up to the same horizon.
        speed: Successes per hour of running.
        interventions: Interrupted runs per hour of running.
        failures: Failure modes, most frequent first.
        smoothness: SPARC of the measured motion, over the trials with a recording.
        commanded: SPARC of the sent commands.
        series: Index of its colour in every figure of its evaluation.
    """

    checkpoint: str
    success: Proportion
    exact: Interval | None
    posterior: Posterior
    score: BoundedMean
    macro: BoundedMean
    scenes: dict[str, Proportion]
    cells: dict[str, Proportion]
    funnels: tuple[Funnel, ...]
    curve: Curve | None
    mean_time: RestrictedMean | None
    speed: Rate | None
    interventions: Rate | None
    failures: tuple[FailureMode, ...]
    smoothness: Average | None
    commanded: Average | None
    series: int = 0


@dataclass(frozen=True, slots=True)
class Within:
    """Exact test within `strata` strata in which both checkpoints were tried."""

    p: float
    strata: int


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of a planned comparison by its design: whether it has ended, and whether it separated the two.

    `apart` is None if the question is not whether they differ (non-inferiority), or if it has not ended. `evidence` is
    the outcome ("success", "score") whose e-process is the design, "" for any other design.
    """

    ended: bool = False
    apart: bool | None = None
    evidence: str = ""


class Standing(StrEnum):
    """Status of a comparison: unplanned, decided by its plan's design, or planned and still open."""

    UNPLANNED = "not planned"
    DECIDED = "decided"
    OPEN = "open"


@dataclass(frozen=True, slots=True)
class Comparison:
    """Comparison of two checkpoints: the first minus the second.

    A planned comparison is decided by its design alone, once that has ended. While it is open, tests, evidence and
    letters are omitted and only descriptions remain.

    Attributes:
        standing: Whether the comparison is planned, and decided.
        alpha: This comparison's share of alpha.
        test: Barnard's test, for a number of trials fixed beforehand.
        corrected: Its probability after Holm's correction for all pairs of the evaluation.
        better: Posterior probability that the first is better.
        scored: Sign-flip test of the pairs' scores, for a number of trials fixed beforehand.
        within: Exact tests within conditions, scenes, operators and stations, if several strata are informative.
        scenes: Difference in each scene, if there are several.
        interaction: Probability of scenes differing this much if the odds ratio is the same in all.
        evidence: Anytime-valid evidence on success; may be examined at any time.
        score_evidence: The same on the scores.
        anytime: Confidence sequence of the mean difference of successes at 1 - alpha; None if no difference fits
            all pairs.
        score_anytime: The same for the scores.
        time_test: Sign-flip test of times to success [s] by pair, with failures counted as the horizon.
    """

    first: str
    second: str
    standing: Standing
    alpha: float
    difference: Difference
    test: ExactTest | None
    corrected: float | None
    better: float | None
    pairs: int
    paired: McNemar | None
    scored: SignFlipTest | None
    clustered: Difference | None
    stratified: Stratified | None
    within: dict[str, Within]
    scenes: dict[str, Difference]
    interaction: float | None
    evidence: Evidence | None
    score_evidence: Evidence | None
    anytime: Interval | None
    score_anytime: Interval | None
    time_test: SignFlipTest | None
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Recipe:
    """Training runs of one recipe: the success rate of each, and their mean with an interval over runs instead of
    trials.

    With fewer than three runs there is no interval: it has to cover what another training run would achieve.
    """

    name: str
    rates: dict[str, float]
    mean: Average


@dataclass(frozen=True, slots=True)
class Analysis:
    """Analysis of an evaluation: its arms, best first, all comparisons with summarising letters, and recipes
    with several runs.
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

    The design alone decides planned comparisons: letters separate what it separated, and while it is undecided there
    are neither letters nor anything else that could pass for a decision.

    Args:
        outcomes: Trials that count.
        interruptions: Interrupted runs; they only count for the rate of interventions.
        alpha: Error probability of all comparisons together.
        planned: Verdicts by planned comparison, in their direction; for others the better checkpoint is first.
        in_pairs: False for random order: a block then has trials of the checkpoints that were drawn, and there are
            no pairs.
        limits: Time limits [s] of the scenes that have one. The smallest is the horizon of times to success;
            without any, the longest run.
        checkpoints: All checkpoints of the evaluation in the order of their colours, whichever were selected.
        whole: Whether these are all trials of a plan, with blocks numbered from 0. Evidence then ends before the
            first incomplete block, as in the plan's design: otherwise the choice of the next trial could influence
            it.
        recipes: Recipe of each checkpoint that is one of its training runs.
    """
    by_design = planned or {}
    arms, timing = by_checkpoint(outcomes), _TimeHorizon.of(outcomes, limits or {})
    series = list(dict.fromkeys([*checkpoints, *sorted(arms)]))
    ranked = sorted(arms, key=lambda name: (-sum(o.success for o in arms[name]) / len(arms[name]), name))
    couples = [_directed(couple, by_design) for couple in combinations(ranked, 2)]
    tests = [_test(arms[one], arms[other]) for one, other in couples]
    corrected = holm([test.p for test in tests])
    comparisons = tuple(
        _comparison(
            one,
            other,
            arms[one],
            arms[other],
            test,
            p,
            _share(alpha, couples, by_design, (one, other)),
            by_design.get((one, other)),
            timing,
            in_pairs,
            whole,
        )
        for (one, other), test, p in zip(couples, tests, corrected, strict=True)
    )
    apart = {frozenset((c.first, c.second)) for c in comparisons if _apart(c, by_design, alpha)}
    told = all(by_design[c.first, c.second].apart is not None for c in comparisons if _is_planned(c))
    return Analysis(
        len(outcomes),
        tuple(
            replace(
                _arm(name, arms[name], [i for i in interruptions if i.checkpoint == name], timing),
                series=series.index(name),
            )
            for name in ranked
        ),
        comparisons,
        letters(ranked, apart) if told else {},
        alpha,
        tuple(_imbalances(arms)),
        tuple(_recipes(arms, recipes or {})),
    )


_FEWEST_RUNS = 3  # runs of a recipe for an interval


def _recipes(arms: Mapping[str, Sequence[Outcome]], recipes: Mapping[str, str]) -> Iterator[Recipe]:
    """Yield the recipes of which several runs were tried."""
    runs: dict[str, dict[str, float]] = defaultdict(dict)
    for name in sorted(arms):
        if recipes.get(name):
            successes, n = _counts(arms[name])
            runs[recipes[name]][name] = successes / n
    for recipe, rates in sorted(runs.items()):
        mean = average(list(rates.values()))
        if len(rates) > 1 and mean is not None:
            yield Recipe(recipe, rates, mean if len(rates) >= _FEWEST_RUNS else replace(mean, interval=None))


@dataclass(frozen=True, slots=True)
class _TimeHorizon:
    """Horizon of times to success [s], 0 without any duration, and the time limits of scenes [s]."""

    until: float
    limits: Mapping[str, float]

    @classmethod
    def of(cls, outcomes: Sequence[Outcome], limits: Mapping[str, float]) -> _TimeHorizon:
        longest = max((o.duration for o in outcomes if o.duration is not None), default=0.0)
        return cls(min(limits.values(), default=longest), limits)

    def known(self, outcome: Outcome) -> bool:
        """Return True if the trial's duration is known."""
        return outcome.duration is not None and self.until > 0

    def time(self, outcome: Outcome) -> float | None:
        """Return the time to success [s], None for a failure; capped at the scene's limit, because a run ends
        shortly after it.
        """
        if not outcome.success or outcome.duration is None:
            return None
        return min(outcome.duration, self.limits.get(outcome.scene, outcome.duration))

    def time_within_horizon(self, outcome: Outcome) -> float:
        """Return the time to success within the horizon; a failure counts as the horizon."""
        time = self.time(outcome)
        return self.until if time is None else min(time, self.until)


def _is_planned(found: Comparison) -> bool:
    return found.standing is not Standing.UNPLANNED


def _apart(found: Comparison, by_design: Mapping[tuple[str, str], Verdict], alpha: float) -> bool:
    if _is_planned(found):
        return bool(by_design[found.first, found.second].apart)
    return found.corrected is not None and found.corrected <= alpha


def _directed(couple: tuple[str, str], planned: Iterable[tuple[str, str]]) -> tuple[str, str]:
    return next((pair for pair in planned if set(pair) == set(couple)), couple)


def _share(
    alpha: float,
    couples: Sequence[tuple[str, str]],
    planned: Collection[tuple[str, str]],
    couple: tuple[str, str],
) -> float:
    """Return alpha of one comparison: planned comparisons share all of it; each other one has an equal share
    among all.
    """
    return alpha / (len(planned) if couple in planned else len(couples))


def _counts(trials: Sequence[Outcome]) -> tuple[int, int]:
    return sum(o.success for o in trials), len(trials)


def _test(first: Sequence[Outcome], second: Sequence[Outcome]) -> ExactTest:
    return barnard(*_counts(first), *_counts(second))


def _arm(name: str, trials: list[Outcome], interruptions: list[Interruption], timing: _TimeHorizon) -> Arm:
    successes, n = _counts(trials)
    scenes, cells = _grouped(trials, lambda o: o.scene), _grouped(trials, lambda o: o.condition)
    timed = [o for o in trials if o.duration is not None]
    durations = [o.duration for o in timed if o.duration is not None]
    succeeded = [o.success for o in timed]
    times = [timing.time(o) for o in timed if timing.known(o)]
    return Arm(
        name,
        proportion(successes, n),
        clopper_pearson(successes, n),
        posterior(successes, n),
        bounded_mean({"all": [o.score for o in trials]}, seed=SEED),
        bounded_mean({key: [float(o.success) for o in rows] for key, rows in scenes.items()}, seed=SEED),
        {key: proportion(*_counts(rows)) for key, rows in scenes.items()},
        {key: proportion(*_counts(rows)) for key, rows in cells.items()},
        tuple(_funnel(scene, rows) for scene, rows in scenes.items() if rows[0].milestones),
        cumulative_incidence(times, timing.until) if times else None,
        restricted_mean(times, timing.until, seed=SEED) if times else None,
        rate(sum(succeeded), sum(durations)) if timed and sum(durations) > 0 else None,
        _interventions(durations, interruptions),
        _failures(trials),
        average([o.smoothness for o in trials if o.smoothness is not None]),
        average([o.commanded for o in trials if o.commanded is not None]),
    )


def _failures(trials: Sequence[Outcome]) -> tuple[FailureMode, ...]:
    n = len(trials)
    counts = Counter((o.failure_phase, o.failure) for o in trials if not o.success)
    modes = (
        FailureMode(phase, cause, count, n, clopper_pearson(count, n))
        for (phase, cause), count in counts.items()
    )
    return tuple(
        sorted(modes, key=lambda mode: (-mode.count, not mode.phase, mode.phase, not mode.cause, mode.cause))
    )


def _interventions(durations: list[float], interruptions: list[Interruption]) -> Rate | None:
    exposure = sum(durations) + sum(i.duration for i in interruptions if i.duration is not None)
    return rate(len(interruptions), exposure) if exposure > 0 else None


def _funnel(scene: str, trials: Sequence[Outcome]) -> Funnel:
    labels = trials[0].labels or tuple(str(i + 1) for i in range(len(trials[0].milestones)))
    return Funnel(scene, labels, tuple(funnel([o.milestones for o in trials])))


def _comparison(
    one: str,
    other: str,
    first: list[Outcome],
    second: list[Outcome],
    test: ExactTest,
    corrected: float,
    alpha: float,
    verdict: Verdict | None,
    timing: _TimeHorizon,
    in_pairs: bool,
    whole: bool,
) -> Comparison:
    notes: list[str] = []
    pairs = pair_by_block(first, second) if in_pairs else []
    told = unbroken(pairs) if whole else pairs
    if len(told) < len(pairs):
        notes.append(_later(len(pairs) - len(told)))
    counts = (*_counts(first), *_counts(second))
    found = Comparison(
        one,
        other,
        Standing.UNPLANNED if verdict is None else Standing.DECIDED if verdict.ended else Standing.OPEN,
        alpha,
        newcombe(*counts),
        test,
        corrected,
        probability_better(*counts),
        len(pairs),
        mcnemar([(p.first.success, p.second.success) for p in pairs]) if pairs else None,
        sign_flip_test([p.first.score - p.second.score for p in pairs]) if pairs else None,
        _compute_or_note(notes, lambda: _clustered(first, second)),
        _compute_or_note(notes, lambda: _stratified(first, second)),
        _within(first, second),
        *_by_scene(first, second),
        success_evidence([(p.first.success, p.second.success) for p in told], alpha),
        score_evidence([(p.first.score, p.second.score) for p in told], alpha),
        confidence_sequence([float(p.first.success) - p.second.success for p in told], alpha),
        confidence_sequence([p.first.score - p.second.score for p in told], alpha),
        _sooner(pairs, timing),
        (*notes, *(_unpaired_note(pairs, first, second) if in_pairs else [_RANDOM])),
    )
    return found if verdict is None or verdict.ended else _described(found, verdict.evidence)


def _described(found: Comparison, evidence: str) -> Comparison:
    """Return an open comparison without inference; only descriptions, and the evidence that is its design, remain."""
    kept = {"": (None, None), "success": (found.evidence, None), "score": (None, found.score_evidence)}
    own, own_score = kept[evidence]
    return replace(
        found,
        test=None,
        corrected=None,
        better=None,
        paired=None,
        scored=None,
        stratified=None,
        within={},
        interaction=None,
        evidence=own,
        score_evidence=own_score,
        anytime=None,
        score_anytime=None,
        time_test=None,
    )


def _clustered(first: Sequence[Outcome], second: Sequence[Outcome]) -> Difference:
    ours, theirs = (
        {key: [float(o.success) for o in rows] for key, rows in _grouped(arm, lambda o: o.condition).items()}
        for arm in (first, second)
    )
    return over_conditions(ours, theirs, seed=SEED, level=LEVEL)


def _stratified(first: Sequence[Outcome], second: Sequence[Outcome]) -> Stratified | None:
    ours, theirs = _grouped(first, lambda o: o.scene), _grouped(second, lambda o: o.scene)
    shared = sorted(set(ours) & set(theirs))
    if len(set(ours) | set(theirs)) < 2:
        return None  # a single scene cannot be stratified
    return mantel_haenszel([StratumTable(*_counts(ours[key]), *_counts(theirs[key])) for key in shared])


STRATA: dict[str, Callable[[Outcome], str]] = {
    "condition": lambda o: o.condition,
    "scene": lambda o: o.scene,
    "operator": lambda o: o.operator,
    "station": lambda o: o.station,
}


def _tables(
    first: Sequence[Outcome], second: Sequence[Outcome], key: Callable[[Outcome], str]
) -> dict[str, StratumTable]:
    """Return the tables of the strata in which both were tried."""
    ours, theirs = _grouped(first, key), _grouped(second, key)
    return {
        name: StratumTable(*_counts(ours[name]), *_counts(theirs[name])) for name in ours if name in theirs
    }


def _within(first: Sequence[Outcome], second: Sequence[Outcome]) -> dict[str, Within]:
    found = {}
    for name, key in STRATA.items():
        tables = list(_tables(first, second, key).values())
        p = exact_within(tables)
        if p is not None:
            found[name] = Within(p, len(tables))
    return found


def _by_scene(
    first: Sequence[Outcome], second: Sequence[Outcome]
) -> tuple[dict[str, Difference], float | None]:
    tables = _tables(first, second, STRATA["scene"])
    if len(tables) < 2:
        return {}, None
    differences = {name: newcombe(t.x1, t.n1, t.x2, t.n2) for name, t in tables.items()}
    return differences, interaction(list(tables.values()))


def _sooner(pairs: Sequence[Pair], timing: _TimeHorizon) -> SignFlipTest | None:
    known = [p for p in pairs if timing.known(p.first) and timing.known(p.second)]
    if not known:
        return None
    return sign_flip_test(
        [timing.time_within_horizon(p.first) - timing.time_within_horizon(p.second) for p in known],
        timing.until,
    )


def _unpaired_note(pairs: Sequence[Pair], first: Sequence[Outcome], second: Sequence[Outcome]) -> list[str]:
    left = len(first) + len(second) - 2 * len(pairs)
    if not left:
        return []
    waiting = "1 trial has" if left == 1 else f"{left} trials have"
    return [f"{waiting} no partner in the block yet, and no part in the evidence"]


def _later(pairs: int) -> str:
    come = "1 pair comes" if pairs == 1 else f"{pairs} pairs come"
    return f"{come} after a block that lacks a trial, and no part in the evidence until it has it"


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


def _grouped(trials: Sequence[Outcome], key: Callable[[Outcome], str]) -> dict[str, list[Outcome]]:
    found: dict[str, list[Outcome]] = defaultdict(list)
    for outcome in trials:
        found[key(outcome)].append(outcome)
    return dict(sorted(found.items()))


def _compute_or_note(notes: list[str], compute: Callable[[], T]) -> T | None:
    """Return the result of `compute`, or None after adding the reason to `notes`."""
    try:
        return compute()
    except StatisticsError as error:
        notes.append(str(error))
        return None
