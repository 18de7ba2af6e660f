"""Comparison of two checkpoints; each field of the class `Comparison` declares one statistic."""

# ruff: noqa: RUF009 - calls in the body of `Comparison` declare its fields
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Any

from evaweb.results.analysis.arm import SEED
from evaweb.results.analysis.json_forms import write_evidence, write_gaffke, write_interval, write_newcombe
from evaweb.results.analysis.outcomes import (
    Outcome,
    Pair,
    TimeHorizon,
    count_successes,
    grouped,
    pair_by_block,
    unbroken,
)
from evaweb.results.analysis.statistic import Answer, compute_all, statistic, statistics_of, write_all
from evaweb.results.analysis.wording import (
    anytime_text,
    evidence_text,
    format_points,
    p_words,
    probability,
    signed_points,
)
from evaweb.statistics.base import LEVEL, Interval
from evaweb.statistics.confidence_sequence import confidence_sequence
from evaweb.statistics.difference import Difference, ExactTest, newcombe, probability_better
from evaweb.statistics.paired import McNemar, mcnemar, over_conditions
from evaweb.statistics.permutation import SignFlipTest, sign_flip_test
from evaweb.statistics.sequential import Evidence, score_evidence, success_evidence
from evaweb.statistics.stratified import Stratified, StratumTable, exact_within, interaction, mantel_haenszel

_RANDOM = "checkpoints came in random order: there are no pairs"
# A small p may also come from different spreads around the same mean.
_EXCHANGEABLE = "sign flips within pairs, exact: are both exchangeable?"
STRATA: dict[str, Callable[[Outcome], str]] = {
    "condition": lambda o: o.condition,
    "scene": lambda o: o.scene,
    "operator": lambda o: o.operator,
    "station": lambda o: o.station,
}


@dataclass(frozen=True, slots=True)
class Within:
    """Result of an exact test that is stratified, for example by scene: p-value `p`, and number of strata used.

    A stratum is used if both checkpoints were tried in it.
    """

    p: float
    strata: int


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of a planned comparison by its design.

    Attributes:
        ended: Whether the design has reached its end.
        apart: Whether it separated the two checkpoints; None if it has not ended, or if it does not test whether they
            differ (non-inferiority).
        evidence: If the design is a test by e-values, the outcome that it tests ("success" or "score"); else "".
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
class AnswerContext:
    """Facts about the whole analysis that change how the answers of a comparison are worded.

    `fixed`: the number of trials was fixed beforehand. `several`: the analysis has several comparisons.
    """

    fixed: bool
    several: bool


@dataclass(frozen=True)
class ComparedTrials:
    """Trials of two checkpoints, from which the statistics of their comparison are computed.

    Attributes:
        first: Trials of the first checkpoint.
        second: Trials of the second checkpoint.
        test: Barnard's test of their success rates.
        corrected: p-value of `test` after Holm's correction.
        alpha: This comparison's share of alpha.
        timing: Horizon of times to success.
        in_pairs: False for checkpoints in random order.
        whole: Whether these are all trials of a plan.
    """

    first: Sequence[Outcome]
    second: Sequence[Outcome]
    test: ExactTest
    corrected: float
    alpha: float
    timing: TimeHorizon
    in_pairs: bool
    whole: bool

    @cached_property
    def pairs(self) -> list[Pair]:
        """Pairs of the two checkpoints' trials in the same block; [] for random order."""
        return pair_by_block(self.first, self.second) if self.in_pairs else []

    @cached_property
    def evidence(self) -> list[Pair]:
        """Pairs that count as evidence: in a whole plan only those before the first incomplete block."""
        return unbroken(self.pairs) if self.whole else self.pairs

    @property
    def counts(self) -> tuple[int, int, int, int]:
        """Successes and trials of the first checkpoint, then of the second."""
        return (*count_successes(self.first), *count_successes(self.second))

    @property
    def successes(self) -> list[tuple[bool, bool]]:
        """Successes of the first and of the second checkpoint, for each of the pairs that count as evidence."""
        return [(pair.first.success, pair.second.success) for pair in self.evidence]

    @property
    def scores(self) -> list[tuple[float, float]]:
        """Scores of the first and of the second checkpoint, for each of the pairs that count as evidence."""
        return [(pair.first.score, pair.second.score) for pair in self.evidence]

    def tables(self, stratum: str) -> dict[str, StratumTable]:
        """Return successes and trials of both checkpoints for each value of `stratum` at which both were tried."""
        first, second = (grouped(trials, STRATA[stratum]) for trials in (self.first, self.second))
        return {
            name: StratumTable(*count_successes(first[name]), *count_successes(second[name]))
            for name in first
            if name in second
        }

    @property
    def scenes(self) -> dict[str, StratumTable]:
        """Table of successes and trials by scene; {} unless both checkpoints were tried in several scenes."""
        tables = self.tables("scene")
        return tables if len(tables) > 1 else {}


def _compare_conditions(t: ComparedTrials) -> Difference:
    first, second = (
        {key: [float(o.success) for o in rows] for key, rows in grouped(arm, STRATA["condition"]).items()}
        for arm in (t.first, t.second)
    )
    return over_conditions(first, second, seed=SEED, level=LEVEL)


def _stratify(t: ComparedTrials) -> Stratified | None:
    if len({o.scene for o in (*t.first, *t.second)}) < 2:
        return None  # a single scene cannot be stratified
    return mantel_haenszel(list(t.tables("scene").values()))


def _test_within(t: ComparedTrials) -> dict[str, Within]:
    tests = {}
    for name in STRATA:
        tables = list(t.tables(name).values())
        p = exact_within(tables)
        if p is not None:
            tests[name] = Within(p, len(tables))
    return tests


def _test_times(t: ComparedTrials) -> SignFlipTest | None:
    timing = t.timing
    timed = [p for p in t.pairs if timing.known(p.first) and timing.known(p.second)]
    if not timed:
        return None
    return sign_flip_test(
        [timing.time_within_horizon(p.first) - timing.time_within_horizon(p.second) for p in timed],
        timing.until,
    )


def _answer_chance(c: Comparison, test: ExactTest, context: AnswerContext) -> list[Answer]:
    fixed = "n as planned" if context.fixed else "as if n had been fixed"
    corrected = f", Holm {probability(c.corrected)}" if context.several and c.corrected is not None else ""
    return [
        ("Is the difference significant?", f"Barnard, two-sided, {fixed}", f"{p_words(test.p)}{corrected}")
    ]


def _answer_scenes(_: Comparison, effect: Stratified, __: AnswerContext) -> list[Answer]:
    ratio = "without bound" if effect.odds_ratio is None else f"{effect.odds_ratio:.2g}"
    over = f"{signed_points(effect.stratified)}, odds ratio {ratio}, p = {probability(effect.p)}"
    return [("Over scenes?", "Mantel-Haenszel", over)]


def _answer_interaction(
    c: Comparison, differences: Mapping[str, Difference], _: AnswerContext
) -> list[Answer]:
    by_scene = "; ".join(f"{name} {format_points(difference)}" for name, difference in differences.items())
    chance = "too many ways to count" if c.interaction is None else p_words(c.interaction)
    text = by_scene if c.standing is Standing.OPEN else f"{chance}: {by_scene}"
    return [("Does it depend on the scene?", "interaction, Zelen, exact", text)] if differences else []


def _answer_times(c: Comparison, test: SignFlipTest, _: AnswerContext) -> list[Answer]:
    ahead = c.first if test.value < 0 else c.second
    lead = f"{ahead} by {abs(test.value):.1f} s, failures counted in full" if test.value else "neither"
    text = f"{lead}, {p_words(test.p)} of {test.pairs} pairs"
    return [("Which is faster?", _EXCHANGEABLE, text)]


def _answer_anytime(question: str, c: Comparison, interval: Interval | None) -> list[Answer]:
    how = f"confidence sequence, {100 * (1 - c.alpha):.3g} %"
    return [] if c.standing is Standing.OPEN else [(question, how, anytime_text(interval, c.pairs))]


def _write_anytime(c: Comparison) -> dict[str, Any] | None:
    if c.standing is Standing.OPEN:
        return None
    ends = {"success": write_interval(c.anytime), "score": write_interval(c.score_anytime)}
    return {"level": 1 - c.alpha, **ends}


def _format_chance(p: float) -> str:
    return "above 0.999" if p > 0.999 else "below 0.001" if p < 0.001 else f"{p:.3f}"


@dataclass(frozen=True, slots=True)
class Comparison:
    """Comparison of two checkpoints: the first minus the second.

    A planned comparison is decided by its design alone, once that has ended. While it is open, tests, evidence and
    letters are omitted and only descriptions remain.

    Attributes:
        standing: Whether the comparison is planned, and decided.
        alpha: This comparison's share of alpha.
        test: Barnard's test, for a number of trials fixed beforehand.
        corrected: p-value of `test` after Holm's correction for all pairs of the evaluation.
        better: Posterior probability that the first checkpoint has the higher success rate.
        scored: Sign-flip test of the pairs' scores, for a number of trials fixed beforehand.
        within: Exact tests within conditions, scenes, operators and stations, if several strata are informative.
        scenes: Difference in each scene, if there are several.
        interaction: Probability of scenes differing this much if the odds ratio is the same in all.
        evidence: Anytime-valid evidence on success; may be examined at any time.
        score_evidence: Anytime-valid evidence on the scores.
        anytime: Confidence sequence of the mean difference of successes at 1 - alpha; None if no difference fits
            all pairs.
        score_anytime: Confidence sequence of the mean difference of scores.
        time_test: Sign-flip test of times to success [s] by pair, with failures counted as the horizon.
    """

    first: str
    second: str
    standing: Standing
    alpha: float
    difference: Difference = statistic(
        lambda t: newcombe(*t.counts),
        "difference",
        write_newcombe,
        answers=lambda c, found, _: [("How much better?", "Newcombe, 95 %", format_points(found))],
        describes=True,
    )
    test: ExactTest | None = statistic(
        lambda t: t.test,
        write=lambda c: {"barnard": c.test and {**asdict(c.test), "holm": c.corrected}},
        answers=_answer_chance,
    )
    corrected: float | None = statistic(lambda t: t.corrected)
    better: float | None = statistic(
        lambda t: probability_better(*t.counts),
        "probability_better",
        answers=lambda c, p, _: [
            ("Bayesian view", "uniform priors", f"{c.first} is better with probability {_format_chance(p)}")
        ],
        rank=3,
    )
    pairs: int = statistic(lambda t: len(t.pairs), "pairs", describes=True)
    paired: McNemar | None = statistic(
        lambda t: mcnemar([(p.first.success, p.second.success) for p in t.pairs]) if t.pairs else None,
        "mcnemar",
        asdict,
        answers=lambda c, found, _: [
            (
                "The same, pair by pair?",
                "McNemar, exact",
                f"{p_words(found.p)} of {c.pairs} pairs "
                f"(only {c.first} {found.first_only}, only {c.second} {found.second_only})",
            )
        ],
    )
    scored: SignFlipTest | None = statistic(
        lambda t: sign_flip_test([p.first.score - p.second.score for p in t.pairs]) if t.pairs else None,
        "scores",
        asdict,
        answers=lambda c, found, _: [
            (
                "With partial credit, n as planned?",
                _EXCHANGEABLE,
                f"{signed_points(found.value)} of the score, {p_words(found.p)} of {c.pairs} pairs",
            )
        ],
    )
    clustered: Difference | None = statistic(
        _compare_conditions,
        "over_conditions",
        write_gaffke,
        answers=lambda c, found, _: [
            ("Other initial conditions?", "conditions as a sample, Gaffke, 95 %", format_points(found))
        ],
        describes=True,
    )
    stratified: Stratified | None = statistic(
        _stratify, "over_scenes", asdict, answers=_answer_scenes, rank=2
    )
    within: dict[str, Within] = statistic(
        _test_within,
        "within",
        lambda found: {name: asdict(one) for name, one in found.items()},
        answers=lambda c, found, _: [
            (f"The same within {name}s?", "exact, conditional", f"{p_words(one.p)} over {one.strata} {name}s")
            for name, one in found.items()
        ],
        rank=2,
    )
    scenes: dict[str, Difference] = statistic(
        lambda t: {name: newcombe(one.x1, one.n1, one.x2, one.n2) for name, one in t.scenes.items()},
        write=lambda c: {
            "by_scene": {
                "differences": {name: write_newcombe(one) for name, one in c.scenes.items()},
                "interaction_p": c.interaction,
            }
        },
        answers=_answer_interaction,
        rank=2,
        describes=True,
    )
    interaction: float | None = statistic(
        lambda t: interaction(list(t.scenes.values())) if t.scenes else None
    )
    evidence: Evidence | None = statistic(
        lambda t: success_evidence(t.successes, t.alpha),
        "evidence",
        write_evidence,
        answers=lambda c, found, _: [
            ("Enough evidence to stop?", f"e-process, alpha {c.alpha:.2g}", evidence_text(found))
        ],
        rank=1,
    )
    score_evidence: Evidence | None = statistic(
        lambda t: score_evidence(t.scores, t.alpha),
        "score_evidence",
        write_evidence,
        answers=lambda c, found, _: [
            ("With partial credit, at any time?", "betting e-process on scores", evidence_text(found))
        ],
        rank=1,
    )
    anytime: Interval | None = statistic(
        lambda t: confidence_sequence([float(one) - other for one, other in t.successes], t.alpha),
        write=lambda c: {"anytime": _write_anytime(c)},
        answers=lambda c, found, _: _answer_anytime("How much better, at any time?", c, found),
        rank=1,
        none_too=True,
    )
    score_anytime: Interval | None = statistic(
        lambda t: confidence_sequence([one - other for one, other in t.scores], t.alpha),
        answers=lambda c, found, _: _answer_anytime("With partial credit, how much at any time?", c, found),
        rank=1,
        none_too=True,
    )
    time_test: SignFlipTest | None = statistic(
        _test_times,
        "sooner",
        lambda found: {"pairs": found.pairs, "value_s": found.value, "p": found.p},
        answers=_answer_times,
        rank=2,
    )
    notes: tuple[str, ...]

    @property
    def document(self) -> dict[str, Any]:
        """Comparison as JSON."""
        names = {"first": self.first, "second": self.second, "standing": self.standing.value}
        return {**names, **write_all(self)}


_OF_DESIGN = {"success": "evidence", "score": "score_evidence"}  # statistic that is the design of an outcome


def compare(names: tuple[str, str], trials: ComparedTrials, verdict: Verdict | None) -> Comparison:
    """Return the comparison of the two checkpoints called `names`.

    `verdict` is what the plan's design says about the comparison; None if the comparison was not planned.
    """
    notes = _later(len(trials.pairs) - len(trials.evidence))
    statistics = compute_all(Comparison, trials, notes)
    notes += _unpaired(trials) if trials.in_pairs else [_RANDOM]
    standing = Standing.UNPLANNED if verdict is None else Standing.DECIDED if verdict.ended else Standing.OPEN
    comparison = Comparison(*names, standing, trials.alpha, **statistics, notes=tuple(notes))
    return comparison if verdict is None or verdict.ended else _described(comparison, verdict.evidence)


def _described(comparison: Comparison, evidence: str) -> Comparison:
    """Return an open comparison without its tests, evidence and letters: those fields become None or {}.

    Descriptive statistics remain. `evidence` is the outcome ("success" or "score") that the plan's design tests by
    e-values, or "" if it tests none. The evidence on that outcome remains too.
    """
    left = (
        name
        for name, row in statistics_of(Comparison).items()
        if not row.describes and name != _OF_DESIGN.get(evidence)
    )
    empty: dict[str, Any] = {
        name: {} if isinstance(getattr(comparison, name), dict) else None for name in left
    }
    return replace(comparison, **empty)


def _unpaired(trials: ComparedTrials) -> list[str]:
    left = len(trials.first) + len(trials.second) - 2 * len(trials.pairs)
    waiting = "1 trial has" if left == 1 else f"{left} trials have"
    return [f"{waiting} no partner in the block yet, and no part in the evidence"] if left else []


def _later(pairs: int) -> list[str]:
    come = "1 pair comes" if pairs == 1 else f"{pairs} pairs come"
    waiting = f"{come} after a block that lacks a trial, and no part in the evidence until it has it"
    return [waiting] if pairs else []
