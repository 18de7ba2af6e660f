"""Results of plans: statistics, attempts, comparisons, second ratings, judgements, preferences."""

from __future__ import annotations

import json
from datetime import datetime
from typing import Annotated, Any, Literal
from uuid import UUID

from django.http import HttpRequest
from django.urls import reverse
from ninja import Field, Query, Router, Schema
from pydantic import create_model

from evaweb.api.responses import FAILURES, Page, Paging
from evaweb.api.tables import Format, table_response
from evaweb.core.errors import NotFound
from evaweb.core.tabular_export import in_pages
from evaweb.plans.models import Plan
from evaweb.results.analysis.analysis import Analysis
from evaweb.results.analysis.json_forms import write_proportion
from evaweb.results.analysis.planner import Question, question_of, table_of
from evaweb.results.analysis.simulated import compare_with_real, simulated_plans
from evaweb.results.crates.download import crate_response
from evaweb.results.crates.options import CrateOptions
from evaweb.results.models import Judgement, Preference, Rating
from evaweb.results.presentation.citation import citation
from evaweb.results.presentation.plan_result import PlanResult
from evaweb.results.ratings.result_visibility import require_visible_results, sealed_reason
from evaweb.results.reports.reporting import planned_document
from evaweb.results.reports.tables import COLUMNS, outcome_page, outcome_pages
from evaweb.results.selectors import plan_at_reveal, plan_get
from evaweb.trials.failures import FIELDS
from evaweb.trials.models import Score
from runtime.core.sentences import Pattern

_NO_TRIAL_COUNTS_THERE_TRIALS = Pattern(
    "api.results.no_trial_counts_there_trials",
    "no trial of {checkpoint!r:.80} counts; there are trials of: {names}",
)
_NO_COMPARISON_THERE_TRIALS = Pattern(
    "api.results.no_comparison_there_trials",
    "no comparison of {first!r:.80} and {second!r:.80}; there are trials of: {names}",
)

router = Router(tags=["results"])
_USUAL = Question()
_PLAN = "/plans/{name}/{int:version}"


class TrialFilters(Schema):
    """Filters of trials, which must all match; "" matches everything."""

    scene: str = ""
    position: str = ""
    station: str = ""
    operator: str = ""


_FIELDS: dict[str, Any] = {name: (hint, ...) for name, hint in COLUMNS.items()}
OutcomeOut: Any = create_model("OutcomeOut", __base__=Schema, **_FIELDS)


class RatingOut(Schema):
    """Second rating of a trial."""

    uuid: UUID
    trial: int
    rater: str
    success: bool
    score: float
    failure: str
    failure_phase: str
    note: str
    blind: bool
    at: datetime

    @staticmethod
    def of(rating: Rating) -> dict[str, Any]:
        """Return the rating as a flat row."""
        plain = ("uuid", "success", "score", *FIELDS, "note", "blind", "at")
        return {
            **{name: getattr(rating, name) for name in plain},
            "trial": rating.trial_id,
            "rater": rating.rater.get_username(),
        }


class JudgementOut(Schema):
    """Verdict of an automatic judge on a trial.

    `milestones` is JSON: one entry [text, reached, probability of having been reached] per milestone; the last two are
    null
    if the judge gave no verdict on that milestone. `reason` tells why the judge gave no verdict on the trial.
    `pictures` is
    JSON: [[camera, time in s, SHA-256], ...] of the pictures that the judge was shown; `prompt` is the SHA-256 of the
    prompt.
    """

    uuid: UUID
    trial: int
    judge: str
    version: str
    model: str
    milestones: str
    reason: str
    prompt: str
    pictures: str
    at: datetime

    @staticmethod
    def of(row: Judgement) -> dict[str, Any]:
        """Return the judgement as a flat row."""
        plain = ("uuid", "judge", "version", "model", "reason", "prompt", "at")
        listed = ("milestones", "pictures")
        return {
            **{name: getattr(row, name) for name in plain},
            **{name: json.dumps(getattr(row, name), ensure_ascii=False) for name in listed},
            "trial": row.trial_id,
        }


class PreferenceOut(Schema):
    """A rater's preference between two trials, and the reason."""

    uuid: UUID
    first: int
    second: int
    first_checkpoint: str
    second_checkpoint: str
    outcome: str
    why: str
    rater: str
    blind: bool
    at: datetime

    @staticmethod
    def of(row: Preference) -> dict[str, Any]:
        """Return the preference as a flat row."""
        return {
            **{name: getattr(row, name) for name in ("uuid", "outcome", "why", "blind", "at")},
            "first": row.first_id,
            "second": row.second_id,
            "first_checkpoint": row.first.checkpoint.name,
            "second_checkpoint": row.second.checkpoint.name,
            "rater": row.rater.get_username(),
        }


class ScoreRow(Schema):
    """One score of a trial; only the newest counts."""

    uuid: UUID
    trial: int
    rater: str
    source: str
    success: bool
    score: float
    failure: str
    failure_phase: str
    note: str
    reason: str
    scored_at: datetime

    @staticmethod
    def of(score: Score) -> dict[str, Any]:
        """Return the score as a flat row."""
        plain = ("uuid", "source", "success", "score", *FIELDS, "note", "reason", "scored_at")
        return {
            **{name: getattr(score, name) for name in plain},
            "trial": score.trial_id,
            "rater": score.rater.get_username(),
        }


class CrateQuery(Schema):
    """Licence of a crate, an SPDX identifier, and texts in place of those that follow from the plan."""

    license: str
    name: str = ""
    description: str = ""
    lab: str = ""
    date: str = ""
    videos: bool = False


class PlannerIn(Schema):
    """Wanted difference and available time, as on the planner's page."""

    rate: Annotated[float, Field(ge=0, le=1)] = _USUAL.rate
    better: Annotated[float, Field(ge=0, le=1)] = _USUAL.better
    alpha: Annotated[float, Field(ge=0.0001, le=0.5)] = _USUAL.alpha
    power: Annotated[float, Field(ge=0.5, le=0.999)] = _USUAL.power
    cycle_s: Annotated[float, Field(ge=1, le=36_000)] = _USUAL.cycle_s
    checkpoints: Annotated[int, Field(ge=2, le=50)] = _USUAL.checkpoints
    comparing: Literal["all", "control", "pair"] = "all"
    stations: Annotated[int, Field(ge=1, le=100)] = _USUAL.stations
    hours: Annotated[float, Field(ge=0.1, le=10_000)] = _USUAL.hours


@router.get(
    _PLAN + "/results",
    response={200: dict[str, Any], **FAILURES},
    summary="Every statistic",
    url_name="plan-results",
)
def results(request: HttpRequest, name: str, version: int, only: Query[TrialFilters]) -> Any:
    """Return the results of checkpoints, pairs, raters, automatic judges and preferences, with 95 % intervals.

    `headline` and `planned` contain what the plan's design has decided; all other fields describe. A comparison whose
    design has not ended (`standing` is "open") has neither test nor evidence. For a revealed plan the figures are
    of the scores at the reveal; `corrected` has the rates with the current scores, if they differ.
    """
    result = _seen(request, name, version, only)
    plan, headline = result.plan, result.headline
    return {
        "plan": plan.name,
        "version": plan.version,
        "digest": plan.digest,
        "only": {name: value for name, value in only.model_dump().items() if value},
        "headline": headline and headline.document,
        "planned": planned_document(result),
        "caveats": result.caveats,
        **result.analysis.document,
        "corrected": {name: write_proportion(rate) for name, rate in result.corrected.items()},
        "notes": list(result.analysis.notes),
        "agreement": result.agreement,
        "judges": result.judges,
        "preferences": result.preferences,
    }


@router.get(
    _PLAN + "/integrity",
    response={200: dict[str, Any], **FAILURES},
    summary="How the trials were made",
    url_name="plan-integrity",
)
def integrity(request: HttpRequest, name: str, version: int) -> Any:
    """Return looks, voids, corrections, amendments, deviations, delays, and the headline without doubtful trials."""
    result = _seen(request, name, version)
    plan = result.plan
    return {"plan": plan.name, "version": plan.version, "digest": plan.digest, **result.conduct}


@router.get(
    _PLAN + "/simulated",
    response={200: list[dict[str, Any]], **FAILURES},
    summary="Simulated evaluations beside it",
    url_name="plan-simulated",
)
def simulated(request: HttpRequest, name: str, version: int) -> Any:
    """Return the comparison with each plan of the same checkpoints on simulated benches.

    It has rates, rank correlation, mean maximum rank violation, and prediction-powered differences (null with fewer
    than eight matched trials).
    """
    plan = _seen(request, name, version).plan
    user: Any = request.auth  # type: ignore[attr-defined]
    matched = (compare_with_real(plan, row) for row in simulated_plans(plan) if not sealed_reason(row, user))
    return [
        {
            "plan": pair["plan"].name,
            "version": pair["plan"].version,
            "checkpoints": {
                checkpoint: {"real": write_proportion(real), "simulated": write_proportion(played)}
                for checkpoint, real, played in pair["rates"]
            },
            "rank_correlation": pair["rank_correlation"],
            "rank_violation": pair["rank_violation"],
            "differences": [
                {
                    "first": first,
                    "second": second,
                    "value": difference and difference.value,
                    "interval": difference and [difference.interval.low, difference.interval.high],
                }
                for first, second, difference in pair["differences"]
            ],
        }
        for pair in matched
    ]


@router.get(
    _PLAN + "/crate",
    response={200: None, **FAILURES},
    summary="The results as an RO-Crate",
    url_name="plan-crate",
)
def crate(request: HttpRequest, name: str, version: int, options: Query[CrateQuery]) -> Any:
    """Return a zip with the report, the data, the program that recomputes them, and their metadata as RO-Crate 1.3.

    With `videos` it has the videos of the trials that count too. `date` is the day of publication.
    """
    user: Any = request.auth  # type: ignore[attr-defined]
    plan = plan_get(name=name, version=version)
    return crate_response(request, user, plan, CrateOptions(**options.model_dump()))


@router.get(
    "/results/frozen/{digest}",
    response={200: dict[str, Any], **FAILURES},
    summary="A result as its reveal kept it",
    url_name="result-frozen",
)
def frozen(request: HttpRequest, digest: str) -> Any:
    """Return one sentence, one table and one figure with the design, as stored at the reveal; later corrections do not
    change them.
    """
    plan = plan_at_reveal(digest)
    require_visible_results(plan, request.auth)
    later = reverse("api:plan-integrity", args=[plan.name, plan.version])
    return {**citation(plan).document, "later": later}


@router.get(
    _PLAN + "/results/{checkpoint}",
    response={200: dict[str, Any], **FAILURES},
    summary="One checkpoint",
    url_name="plan-checkpoint",
)
def checkpoint(
    request: HttpRequest, name: str, version: int, checkpoint: str, only: Query[TrialFilters]
) -> Any:
    """Return the rates, scores, milestones and times of a checkpoint."""
    analysis = _seen(request, name, version, only).analysis
    row = next((arm for arm in analysis.arms if arm.checkpoint == checkpoint), None)
    if row is None:
        raise NotFound(_NO_TRIAL_COUNTS_THERE_TRIALS(checkpoint=checkpoint, names=_names(analysis)))
    return row.document


@router.get(
    _PLAN + "/comparison",
    response={200: dict[str, Any], **FAILURES},
    summary="Two checkpoints",
    url_name="plan-comparison",
)
def comparison(
    request: HttpRequest, name: str, version: int, first: str, second: str, only: Query[TrialFilters]
) -> Any:
    """Return difference, tests and evidence of the first checkpoint minus the second."""
    analysis = _seen(request, name, version, only).analysis
    row = analysis.comparison_of(first, second)
    if row is None:
        raise NotFound(_NO_COMPARISON_THERE_TRIALS(first=first, second=second, names=_names(analysis)))
    return row.document


@router.get(
    _PLAN + "/outcomes",
    response={200: Page[OutcomeOut], **FAILURES},  # type: ignore[valid-type]
    summary="Every attempt",
    url_name="plan-outcomes",
)
def outcomes(
    request: HttpRequest,
    name: str,
    version: int,
    only: Query[TrialFilters],
    paging: Query[Paging],
    format: Format = "json",
) -> Any:
    """Return the trials in the order in which they were handed out, including those that do not count.

    CSV and Parquet have all of them, without pages.
    """
    result = _seen(request, name, version, only)
    if format != "json":
        name = f"{result.plan.name}-v{result.plan.version}-trials"
        return table_response(request, name, COLUMNS, outcome_pages(result), format)
    return outcome_page(result, paging.offset, paging.limit)


@router.get(
    _PLAN + "/scores",
    response={200: Page[ScoreRow], **FAILURES},
    summary="Every score",
    url_name="plan-scores",
)
def scores(
    request: HttpRequest, name: str, version: int, paging: Query[Paging], format: Format = "json"
) -> Any:
    """Return all scores, including those that were corrected later."""
    plan = _seen(request, name, version).plan
    rows = Score.objects.filter(trial__evaluation=plan.evaluation_id).select_related("rater").order_by("pk")
    return _rows(request, plan, "scores", rows, ScoreRow, paging, format)


@router.get(
    _PLAN + "/ratings",
    response={200: Page[RatingOut], **FAILURES},
    summary="Second ratings",
    url_name="plan-ratings",
)
def ratings(
    request: HttpRequest, name: str, version: int, paging: Query[Paging], format: Format = "json"
) -> Any:
    """Return the ratings of users other than the trial's operator; they never change its score."""
    plan = _seen(request, name, version).plan
    rows = Rating.objects.filter(trial__evaluation=plan.evaluation_id).select_related("rater").order_by("pk")
    return _rows(request, plan, "ratings", rows, RatingOut, paging, format)


@router.get(
    _PLAN + "/judgements",
    response={200: Page[JudgementOut], **FAILURES},
    summary="What automatic judges said",
    url_name="plan-judgements",
)
def judgements(
    request: HttpRequest, name: str, version: int, paging: Query[Paging], format: Format = "json"
) -> Any:
    """Return the judgements of automatic judges: each trial once by each version of a judge.

    They never change its score and are not ratings.
    """
    plan = _seen(request, name, version).plan
    rows = Judgement.objects.filter(trial__evaluation=plan.evaluation_id).order_by("pk")
    return _rows(request, plan, "judgements", rows, JudgementOut, paging, format)


@router.get(
    _PLAN + "/preferences",
    response={200: Page[PreferenceOut], **FAILURES},
    summary="Preferences",
    url_name="plan-preferences",
)
def preferences(
    request: HttpRequest, name: str, version: int, paging: Query[Paging], format: Format = "json"
) -> Any:
    """Return the raters' preferences between two trials at the same initial condition."""
    plan = _seen(request, name, version).plan
    rows = plan.preferences.select_related("rater", "first__checkpoint", "second__checkpoint").order_by("pk")
    return _rows(request, plan, "preferences", rows, PreferenceOut, paging, format)


@router.get(
    "/planner", response={200: dict[str, Any], **FAILURES}, summary="How many trials", url_name="planner"
)
def planner(request: HttpRequest, asked: Query[PlannerIn]) -> Any:
    """Return the trials and robot hours needed for a difference, and the power of as many trials as the time allows."""
    question = question_of({name: str(value) for name, value in asked.model_dump().items()})
    user: Any = request.auth  # type: ignore[attr-defined]
    return {"question": asked.model_dump(), **table_of(question, user.pk)}


def _seen(request: Any, name: str, version: int, only: TrialFilters | None = None) -> PlanResult:
    """Return the result of the plan's selected trials, if the user may see it."""
    plan = plan_get(name=name, version=version)
    require_visible_results(plan, request.auth)
    filters = only.model_dump() if only else {}
    return PlanResult(plan).select(filters) if any(filters.values()) else PlanResult(plan)


def _rows(
    request: HttpRequest, plan: Plan, label: str, rows: Any, shape: Any, paging: Paging, format: Format
) -> Any:
    if format == "json":
        return paging.page(rows, shape)
    columns = {name: field.annotation for name, field in shape.model_fields.items()}
    pages = in_pages(map(shape.of, rows.iterator(chunk_size=1000)))
    return table_response(request, f"{plan.name}-v{plan.version}-{label}", columns, pages, format)


def _names(analysis: Analysis) -> str:
    return ", ".join(arm.checkpoint for arm in analysis.arms) or "none yet"
