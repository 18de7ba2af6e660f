"""Answers of a comparison of two checkpoints: each question with its method, and one summarising sentence."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

from evaweb.plans.design import compared
from evaweb.plans.models import Plan, PrimaryOutcome, StoppingRule
from evaweb.results.analysis.analysis import Analysis, Comparison, Standing
from evaweb.results.analysis.filters import TrialFilter
from evaweb.results.presentation.addresses import compare_address
from evaweb.results.presentation.drawings import rates
from evaweb.results.presentation.plan_result import PlanResult
from evaweb.results.presentation.wording import (
    anytime_text,
    difference_sentence,
    evidence_text,
    format_points,
    p_words,
    probability,
    undetectable_gain_sentence,
)

_DIFFERENCE = "How much better?"
_ANYTIME = "How much better, at any time?"
_SCORE_ANYTIME = "With partial credit, how much at any time?"
# A small p may also come from different spreads around the same mean.
_EXCHANGEABLE = "sign flips within pairs, exact: are both exchangeable?"


@dataclass(frozen=True, slots=True)
class ComparisonFact:
    """Question that a comparison answers, with method and answer; `own` if it is the interval of the plan's design."""

    question: str
    method: str
    answer: str
    own: bool = False


def comparison_sentence(analysis: Analysis, found: Comparison) -> str:
    """Return the comparison as one sentence."""
    one, other = analysis.arm(found.first).success, analysis.arm(found.second).success
    return difference_sentence(found, one, other, analysis.alpha)


def comparison_facts(result: PlanResult, found: Comparison) -> dict[str, Any]:
    """Return sentence and facts of a comparison; the sentence of a planned one comes from its design."""
    plan, analysis = result.plan, result.analysis
    names = compared(plan.document or {})
    planned = result.headline if (found.first, found.second) in names else None
    own = _own_interval(plan) if planned else ""
    return {
        "sentence": planned.sentences[names.index((found.first, found.second))]
        if planned
        else comparison_sentence(analysis, found),
        "headline": planned,
        "names": f"{found.first} and {found.second}",
        "facts": [
            replace(fact, own=fact.question == own)
            for fact in (
                *_of_the_rates(plan, analysis, found),
                *_of_the_evidence(found),
                *_later_facts(found),
            )
        ],
        "standing": found.standing.name.lower(),
        "notes": found.notes,
        "reversed": bool(found.stratified and found.stratified.reversed),
        "missed": undetectable_text(analysis, found),
        "address": compare_address(plan, found, TrialFilter()),
        "difference": rates.draw_difference(found),
    }


def _own_interval(plan: Plan) -> str:
    """Return the question that the interval of the plan's design answers; a boundary's is shown below the
    headline instead.
    """
    by_score = (plan.document or {}).get("stopping", {}).get("outcome") == PrimaryOutcome.SCORE
    if plan.stopping == StoppingRule.EVIDENCE:
        return _SCORE_ANYTIME if by_score else _ANYTIME
    return _DIFFERENCE if plan.stopping == StoppingRule.NONE and not by_score else ""


def _of_the_rates(plan: Plan, analysis: Analysis, found: Comparison) -> Iterator[ComparisonFact]:
    fixed = "n as planned" if plan.stopping == StoppingRule.NONE else "as if n had been fixed"
    yield ComparisonFact(_DIFFERENCE, "Newcombe, 95 %", format_points(found.difference))
    if found.test and found.corrected is not None:
        corrected = f", Holm {probability(found.corrected)}" if len(analysis.comparisons) > 1 else ""
        chance = f"{p_words(found.test.p)}{corrected}"
        yield ComparisonFact("Could it be chance?", f"Barnard, two-sided, {fixed}", chance)
    if found.paired:
        split = (
            f"only {found.first} {found.paired.first_only}, only {found.second} {found.paired.second_only}"
        )
        of_pairs = f"{p_words(found.paired.p)} of {found.pairs} pairs ({split})"
        yield ComparisonFact("The same, pair by pair?", "McNemar, exact", of_pairs)
    if found.scored:
        gain = f"{100 * found.scored.value:+.0f} points".replace("-", "−")
        of_scores = f"{gain} of the score, {p_words(found.scored.p)} of {found.pairs} pairs"
        yield ComparisonFact("With partial credit, n as planned?", _EXCHANGEABLE, of_scores)
    if found.clustered:
        yield ComparisonFact(
            "Other initial conditions?",
            "conditions as a sample, Gaffke, 95 %",
            format_points(found.clustered),
        )


def _of_the_evidence(found: Comparison) -> Iterator[ComparisonFact]:
    if found.evidence:
        yield ComparisonFact(
            "Enough evidence to stop?", f"e-process, alpha {found.alpha:.2g}", evidence_text(found.evidence)
        )
    if found.score_evidence:
        yield ComparisonFact(
            "With partial credit, at any time?",
            "betting e-process on scores",
            evidence_text(found.score_evidence),
        )
    for question, interval in (
        ()
        if found.standing is Standing.OPEN
        else (
            (_ANYTIME, found.anytime),
            (_SCORE_ANYTIME, found.score_anytime),
        )
    ):
        how = f"confidence sequence, {100 * (1 - found.alpha):.3g} %"
        yield ComparisonFact(question, how, anytime_text(interval, found.pairs))


def _later_facts(found: Comparison) -> Iterator[ComparisonFact]:
    if found.stratified:
        odds = found.stratified.odds_ratio
        ratio = "without bound" if odds is None else f"{odds:.2g}"
        points_over = f"{100 * found.stratified.stratified:+.0f} points".replace("-", "−")
        chance = probability(found.stratified.p)
        yield ComparisonFact(
            "Over scenes?", "Mantel-Haenszel", f"{points_over}, odds ratio {ratio}, p = {chance}"
        )
    for name, within in found.within.items():
        over = f"{p_words(within.p)} over {within.strata} {name}s"
        yield ComparisonFact(f"The same within {name}s?", "exact, conditional", over)
    if found.scenes:
        by_scene = "; ".join(
            f"{name} {format_points(difference)}" for name, difference in found.scenes.items()
        )
        chance = "too many ways to count" if found.interaction is None else p_words(found.interaction)
        told = by_scene if found.standing is Standing.OPEN else f"{chance}: {by_scene}"
        yield ComparisonFact("Does it depend on the scene?", "interaction, Zelen, exact", told)
    if found.time_test:
        ahead = found.first if found.time_test.value < 0 else found.second
        by = f"{abs(found.time_test.value):.1f} s"
        lead = f"{ahead} by {by}, failures counted in full" if found.time_test.value else "neither"
        of_times = f"{lead}, {p_words(found.time_test.p)} of {found.time_test.pairs} pairs"
        yield ComparisonFact("Which is faster?", _EXCHANGEABLE, of_times)
    if found.better is not None:
        believed = f"{found.first} is better with probability {_chance(found.better)}"
        yield ComparisonFact("Bayesian view", "uniform priors", believed)


def undetectable_text(analysis: Analysis, found: Comparison | None = None) -> str:
    """Return what these trials could not have detected, at a planned comparison's share of alpha."""
    arms = [arm for arm in analysis.arms if found is None or arm.checkpoint in (found.first, found.second)]
    n = min(arm.success.n for arm in arms)
    rate = min((arm.success.rate for arm in arms if arm.success.rate is not None), default=None)
    compared = analysis.comparisons if found is None else (found,)
    return undetectable_gain_sentence(n, rate, max((one.alpha for one in compared), default=analysis.alpha))


def _chance(p: float) -> str:
    return "above 0.999" if p > 0.999 else "below 0.001" if p < 0.001 else f"{p:.3f}"
