"""Answers of a comparison of two checkpoints: each question with its method, and one summarising sentence."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from evaweb.plans.design import compared
from evaweb.plans.models import Plan, PrimaryOutcome, StoppingRule
from evaweb.results.analysis.analysis import Analysis
from evaweb.results.analysis.comparison import AnswerContext, Comparison
from evaweb.results.analysis.filters import TrialFilter
from evaweb.results.analysis.statistic import answer_all
from evaweb.results.analysis.wording import format_points, undetectable_gain_sentence
from evaweb.results.presentation.addresses import compare_address
from evaweb.results.presentation.drawings import rates
from evaweb.results.presentation.plan_result import PlanResult


@dataclass(frozen=True, slots=True)
class ComparisonFact:
    """Question that a comparison answers, with the method and the answer.

    `own` is True if the answer is the interval by which the plan's design itself estimates the difference.
    """

    question: str
    method: str
    answer: str
    own: bool = False


def comparison_sentence(analysis: Analysis, found: Comparison) -> str:
    """Return the comparison as one sentence that states only the result of the corrected exact test.

    Raises:
        ValueError: If the comparison is planned and still open: its design decides, and has not ended.
    """
    if found.corrected is None:
        raise ValueError(f"{found.first} and {found.second}: their design decides, which has not ended")
    better, worse, difference = found.first, found.second, found.difference
    differs = found.corrected <= analysis.alpha
    if differs and difference.value < 0:
        better, worse, difference = worse, better, difference.swapped
    first, second = analysis.arm(better).success, analysis.arm(worse).success
    counts = (
        f"{first.successes}/{first.n} against {second.successes}/{second.n}, "
        f"difference {format_points(difference)}"
    )
    if differs:
        return f"{better} succeeded more often than {worse}: {counts}"
    return f"No significant difference between {better} and {worse}: {counts}"


def comparison_facts(result: PlanResult, found: Comparison) -> dict[str, Any]:
    """Return the sentence, the facts and the notes of a comparison.

    The sentence of a planned comparison is the conclusion of its design.
    """
    plan, analysis = result.plan, result.analysis
    names = compared(plan.document or {})
    planned = result.headline if (found.first, found.second) in names else None
    return {
        "sentence": planned.sentences[names.index((found.first, found.second))]
        if planned
        else comparison_sentence(analysis, found),
        "headline": planned,
        "names": f"{found.first} and {found.second}",
        "facts": list(_facts(result, found, _own_interval(plan) if planned else "")),
        "standing": found.standing.name.lower(),
        "notes": found.notes,
        "reversed": bool(found.stratified and found.stratified.reversed),
        "missed": undetectable_text(analysis, found),
        "address": compare_address(plan, found, TrialFilter()),
        "difference": rates.draw_difference(found),
    }


def _facts(result: PlanResult, comparison: Comparison, own: str) -> Iterator[ComparisonFact]:
    context = AnswerContext(
        fixed=result.plan.stopping == StoppingRule.NONE, several=len(result.analysis.comparisons) > 1
    )
    for name, answer in answer_all(comparison, context):
        yield ComparisonFact(*answer, name == own)


def _own_interval(plan: Plan) -> str:
    """Return the name of the statistic that is the interval of the plan's design, "" if there is no such statistic.

    There is none for a design with a boundary, because its estimate is shown below the headline instead, and none for a
    fixed design that compares scores.
    """
    by_score = (plan.document or {}).get("stopping", {}).get("outcome") == PrimaryOutcome.SCORE
    if plan.stopping == StoppingRule.EVIDENCE:
        return "score_anytime" if by_score else "anytime"
    return "difference" if plan.stopping == StoppingRule.NONE and not by_score else ""


def undetectable_text(analysis: Analysis, found: Comparison | None = None) -> str:
    """Return a sentence on the gain that these trials could not have detected, at the comparison's share of alpha.

    Without `found` the sentence is about all checkpoints, at the largest share of alpha of any comparison.
    """
    arms = [arm for arm in analysis.arms if found is None or arm.checkpoint in (found.first, found.second)]
    n = min(arm.success.n for arm in arms)
    rate = min((arm.success.rate for arm in arms if arm.success.rate is not None), default=None)
    compared = analysis.comparisons if found is None else (found,)
    return undetectable_gain_sentence(
        n, rate, max((comparison.alpha for comparison in compared), default=analysis.alpha)
    )
