"""Contents of a plan's pages, computed here so that templates only lay them out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from evaweb.core.errors import EvaError
from evaweb.plans.counting import declared_failures
from evaweb.results.analysis import caching
from evaweb.results.analysis.analysis import Analysis
from evaweb.results.analysis.arm import COLUMNS
from evaweb.results.analysis.comparison import Comparison, Standing
from evaweb.results.analysis.filters import filter_choices
from evaweb.results.analysis.integrity import checkpoint_changes
from evaweb.results.analysis.outcomes import by_checkpoint, pair_by_block
from evaweb.results.analysis.wording import anytime_text, evidence_text
from evaweb.results.presentation.addresses import compare_address, trials_address
from evaweb.results.presentation.drawings import rates, time_courses
from evaweb.results.presentation.facts import (
    comparison_facts,
    comparison_sentence,
    undetectable_text,
)
from evaweb.results.presentation.figures import draw_arms
from evaweb.results.presentation.listings import (
    MOST_PAIRS,
    arm_rows,
    differs,
    failure_tables,
    pair_rows,
    scene_rows,
)
from evaweb.results.presentation.plan_result import PlanResult
from evaweb.statistics.designs import Design
from evaweb.trials.failures import ordered_terms
from runtime.core.sentences import Pattern

_NO_COMPARISON_THERE_TRIALS = Pattern(
    "results.pages.pages.no_comparison_there_trials",
    "no comparison of {first!r} and {second!r}; there are trials of: {names}",
)
_DIFFERS_ALLOWED_1_NOTHING = Pattern(
    "results.pages.pages.differs_allowed_1_nothing",
    "differs = {only!r:.80}; allowed: 1, or nothing",
)
_VIEW_ALLOWED = Pattern("results.pages.pages.view_allowed", "view = {view!r:.80}; allowed: {views}")

VIEWS = ("table", "grid")


def summary_page(result: PlanResult) -> dict[str, Any]:
    """Return the contents of the plan's page."""
    order = ordered_terms()
    name = (
        "summary",
        result.only,
        *order.values(),
    )  # the lab's order of failure terms is not part of the trials' fingerprint
    return caching.cached_page(result.plan, name, result.at, lambda: _summary(result, order))


def _summary(result: PlanResult, order: Mapping[str, tuple[str, ...]]) -> dict[str, Any]:
    plan, only, analysis = result.plan, result.only, result.analysis
    outcomes, primaries = result.runs.outcomes, result.primaries
    facts = [comparison_facts(result, comparison) for comparison in primaries]
    scenes = sorted({name for arm in analysis.arms for name in arm.scenes})
    return {
        "analysis": analysis,
        "only": only,
        "choices": filter_choices(outcomes),
        "headline": facts[0]["headline"] if facts else None,
        "primaries": facts,
        "columns": COLUMNS,
        "table": arm_rows(result),
        **draw_arms(analysis.arms, analysis.letters, partial(trials_address, plan, only)),
        "declared": declared_failures(plan).keys() & {row.trial for row in only.apply(outcomes)},
        "failures": failure_tables(analysis, order, partial(trials_address, plan, only, success="no")),
        "scenes": [(scene, scene_rows(result, scene)) for scene in scenes],
        "others": [
            (comparison, comparison_sentence(analysis, comparison), compare_address(plan, comparison, only))
            for comparison in analysis.comparisons
            if comparison not in primaries
        ],
        "missed": [undetectable_text(analysis)] if analysis.arms else [],
        "changes": checkpoint_changes(plan),
    }


def comparison_page(result: PlanResult, first: str, second: str) -> dict[str, Any]:
    """Return the comparison of two checkpoints, condition by condition.

    Raises:
        EvaError: If there is no such comparison; the message names the checkpoints.
    """
    name = ("comparison", result.only, first, second)
    return caching.cached_page(result.plan, name, result.at, lambda: _compared(result, first, second))


def _compared(result: PlanResult, first: str, second: str) -> dict[str, Any]:
    plan, only, analysis = result.plan, result.only, result.analysis
    names = [arm.checkpoint for arm in analysis.arms]
    primaries = result.primaries
    if not first and not second and primaries:
        first, second = primaries[0].first, primaries[0].second
    comparison = analysis.comparison_of(first, second)
    if comparison is None:
        raise EvaError(
            _NO_COMPARISON_THERE_TRIALS(first=first, second=second, names=", ".join(names) or "none")
        )
    arms = (analysis.arm(comparison.first), analysis.arm(comparison.second))
    runs = by_checkpoint(only.apply(result.runs.outcomes))
    return {
        "analysis": analysis,
        "only": only,
        "found": comparison,
        "names": names,
        "facts": comparison_facts(result, comparison),
        "difference": rates.draw_difference(comparison),
        **draw_arms(arms, analysis.letters, partial(trials_address, plan, only)),
        "evidence": comparison.evidence
        and time_courses.draw_evidence(
            comparison.evidence, comparison.first, comparison.second, drawn=(arms[0].series, arms[1].series)
        ),
        "paired": list(
            enumerate(pair_by_block(runs.get(comparison.first, []), runs.get(comparison.second, [])), 1)
        ),
    }


@dataclass(frozen=True, slots=True)
class PairView:
    """Display of a comparison's pairs: all or only those that differ, as a table or a grid."""

    differs: bool = False
    view: str = "table"


def pair_view(given: Mapping[str, str]) -> PairView:
    """Return the display options that the query of an address (`given`) requests.

    Raises:
        EvaError: If a value is not allowed.
    """
    only, view = given.get("differs", ""), given.get("view", "") or "table"
    if only not in ("", "1"):
        raise EvaError(_DIFFERS_ALLOWED_1_NOTHING(only=only))
    if view not in VIEWS:
        raise EvaError(_VIEW_ALLOWED(view=view, views=", ".join(VIEWS)))
    return PairView(only == "1", view)


def pairs_shown(page: Mapping[str, Any], how: PairView) -> dict[str, Any]:
    """Return the pairs of a comparison's page with the current state of their recordings."""
    differing = [row for row in page["paired"] if differs(row[1])]
    fitting = differing if how.differs else page["paired"]
    return {
        "pairs": pair_rows(fitting[:MOST_PAIRS]),
        "fitting": len(fitting),
        "differing": len(differing),
        "how": how,
        "most": MOST_PAIRS,
    }


def evidence_page(result: PlanResult) -> dict[str, Any]:
    """Return the evidence of the plan's comparisons, whether it suffices to stop, and what the trials cannot detect."""
    return caching.cached_page(result.plan, "evidence", result.at, lambda: _evidence(result))


def _evidence(result: PlanResult) -> dict[str, Any]:
    analysis, primaries, design = result.analysis, result.primaries, result.design
    if not primaries or design is None:
        return {"meters": [], "compared": design is not None}
    return {
        "headline": result.headline,
        "meters": [_meter(analysis, comparison, design) for comparison in primaries],
        "missed": undetectable_text(analysis),
    }


def _meter(analysis: Analysis, comparison: Comparison, design: Design) -> dict[str, Any]:
    names = (comparison.first, comparison.second)
    drawn = (analysis.arm(comparison.first).series, analysis.arm(comparison.second).series)
    return {
        "found": comparison,
        "foreseen": design.blocks,
        "by": [
            (
                label,
                time_courses.draw_evidence(evidence, *names, design.blocks, drawn),
                evidence_text(evidence),
            )
            for label, evidence in (
                ("By success and failure", comparison.evidence),
                ("By scores, partial credit included", comparison.score_evidence),
            )
            if evidence
        ],
        "open": comparison.standing is Standing.OPEN,
        "difference": anytime_text(comparison.anytime, comparison.pairs),
        "score_difference": anytime_text(comparison.score_anytime, comparison.pairs),
        "level": 100 * (1 - design.share),
        "wanted": 2 / design.share,
    }
