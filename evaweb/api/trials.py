"""Trials: list, details and operations."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from typing import Annotated, Any
from uuid import UUID

from django.http import HttpRequest
from ninja import Field, Query, Router, Schema
from pydantic import StrictBool, create_model

from evaweb.api.responses import (
    FAILURES,
    Body,
    Page,
    Paging,
)
from evaweb.api.tables import Format, table_response
from evaweb.blinding.visibility import Visibility, visibility_for_request
from evaweb.trials import corrections, selectors, services, voids
from evaweb.trials.failures import FIELDS
from evaweb.trials.models import Score, Trial, TrialStatus, VoidRequest
from evaweb.trials.record import api_columns, visible_columns
from evaweb.trials.selectors import TrialFilters

router = Router(tags=["trials"])


class Filters(Schema):
    """Filters of trials by names or ids, which must all match."""

    evaluation: str = ""
    checkpoint: str = ""
    scene: str = ""
    station: str = ""
    status: Annotated[str, Field(description=f"One of {', '.join(TrialStatus.values)}")] = ""
    since: Annotated[str, Field(description="Prepared on or after this day or time, ISO 8601")] = ""

    def chosen(self) -> TrialFilters:
        """Return the filters as the selectors use them."""
        return TrialFilters(**self.model_dump())


_LIST, _DETAIL = api_columns("list"), api_columns("detail")
_Columns: Any = create_model(
    "_Columns", __base__=Schema, **{name: (hint, ...) for name, hint in _LIST.items()}
)


class TrialOut(_Columns):
    """One attempt as a flat row; success, score, note and rater are those of its newest score.

    `code` is the blind code of a trial of a plan, "" for others. While its checkpoint is hidden from the caller, the
    code also replaces `checkpoint`.
    """

    @staticmethod
    def of(trial: Trial, sight: Visibility) -> dict[str, Any]:
        """Return the trial as a flat row, the same for JSON and CSV."""
        return visible_columns(trial, sight, _LIST)


class OutcomeOut(Schema):
    """A milestone as it was at the time of scoring."""

    order: int
    text: str
    points: int
    required: bool
    reached: bool
    at_s: float | None


class ScoreOut(Schema):
    """One rater's score; only a trial's newest score counts."""

    uuid: UUID
    rater: str
    source: str
    success: bool
    score: float
    note: str
    failure: str
    failure_phase: str
    reason: str
    scored_at: datetime
    milestones: list[OutcomeOut]

    @staticmethod
    def of(score: Score) -> dict[str, Any]:
        """Return the score with its milestones."""
        plain = ("uuid", "source", "success", "score", "note", *FIELDS, "reason", "scored_at")
        return {
            **{name: getattr(score, name) for name in plain},
            "rater": score.rater.get_username(),
            "milestones": list(score.outcomes.all()),
        }


class VoidRequestOut(Schema):
    """Request to void a scored trial of a blind plan; `answer` is "" until a second operator has answered it."""

    uuid: UUID
    reason: str
    by: str
    at: datetime
    answer: str
    answer_reason: str
    answered_by: str | None
    answered_at: datetime | None

    @staticmethod
    def of(row: VoidRequest) -> dict[str, Any]:
        """Return the request with the names of both users."""
        plain = ("uuid", "reason", "at", "answer", "answer_reason", "answered_at")
        return {
            **{name: getattr(row, name) for name in plain},
            "by": row.by.get_username(),
            "answered_by": row.answered_by and row.answered_by.get_username(),
        }


_Detail: Any = create_model(
    "_Detail",
    __base__=TrialOut,
    scores=(list[ScoreOut], ...),
    void_requests=(list[VoidRequestOut], ...),
    **{name: (hint, ...) for name, hint in _DETAIL.items()},
)


class TrialDetail(_Detail):
    """A trial with all its scores (newest first), and the ground truth of a simulated bench at its end."""

    @staticmethod
    def of(trial: Trial, sight: Visibility) -> dict[str, Any]:
        """Return the trial with all details."""
        scores = [ScoreOut.of(score) for score in trial.scores.all()]
        requests = [VoidRequestOut.of(row) for row in trial.void_requests.all()]
        return {
            **visible_columns(trial, sight, (*_LIST, *_DETAIL)),
            "scores": scores,
            "void_requests": requests,
        }


class ScoreIn(Body):
    """A score: every milestone of the scene by id; `success` only if the scene requires none of them.

    For a scored trial it is a correction and needs a `reason`. If the answer was lost, a client sends the same again:
    the `uuid`, or else identical content, identifies it as the first score.
    """

    milestones: Annotated[dict[str, StrictBool], Field(default_factory=dict)]
    times: Annotated[
        dict[str, float | None] | None,
        Field(
            description="When each was reached, s after the start of the run; "
            "a correction without them keeps those of what is still ticked"
        ),
    ] = None
    success: StrictBool | None = None
    note: str = ""
    failure: Annotated[
        str, Field(description="Why it failed, best one of the lab's causes: see /failures")
    ] = ""
    failure_phase: Annotated[
        str, Field(description="In which phase, one of the lab's; then the cause is one of the lab's too")
    ] = ""
    source: str = Score.Source.HUMAN.value
    reason: str = ""
    uuid: Annotated[UUID | None, Field(description="Of your own; another one for each score")] = None


class FailureIn(Body):
    """Phase and cause of a failure; null leaves that field unchanged, "" clears it."""

    failure: str | None = None
    failure_phase: str | None = None
    score: Annotated[
        UUID | None, Field(description="The score that you saw: 409 where another counts by now")
    ] = None
    reason: Annotated[str, Field(description='Without one: "failure was ..., now ..."')] = ""


class Reason(Body):
    """Reason, for later readers."""

    reason: str = ""


class VoidAnswer(Reason):
    """Agreement to a void, or a refusal with its reason."""

    agree: StrictBool


COLUMNS: dict[str, Any] = {**_LIST, "milestones_reached": str, "milestones_missed": str}


@router.get("", response={200: Page[TrialOut], **FAILURES}, summary="Trials", url_name="trials")
def trials(
    request: HttpRequest, filters: Query[Filters], paging: Query[Paging], format: Format = "json"
) -> Any:
    """Return the trials, newest first, in pages; with `format=csv` or `parquet` all that match, oldest first."""
    visibility = visibility_for_request(request)
    if format != "json":
        pages = selectors.trials_in_pages(filters.chosen(), sight=visibility)
        return table_response(request, "trials", COLUMNS, _csv_pages(pages, visibility), format)
    return paging.page(selectors.trial_list(filters.chosen(), visibility), TrialOut, visibility)


@router.get("/{int:id}", response={200: TrialDetail, **FAILURES}, summary="One trial", url_name="trial")
def trial(request: HttpRequest, id: int) -> Any:
    """Return a trial with all its scores."""
    return TrialDetail.of(selectors.trial_get(id=id), visibility_for_request(request))


@router.post("/{int:id}/score", response={200: TrialDetail, **FAILURES}, summary="Score it", url_name="score")
def score(request: HttpRequest, id: int, given: ScoreIn) -> Any:
    """Add a score, or a correction. Requires an operator."""
    trial = selectors.trial_get(id=id)
    services.score_trial(user=request.auth, trial=trial, **given.model_dump())
    return TrialDetail.of(selectors.trial_get(id=id), visibility_for_request(request))


@router.post(
    "/{int:id}/failure",
    response={200: TrialDetail, **FAILURES},
    summary="Correct its failure",
    url_name="failure",
)
def failure(request: HttpRequest, id: int, given: FailureIn) -> Any:
    """Correct only the failure's phase and cause; the earlier score stays in the record.

    Requires an operator.
    """
    trial = selectors.trial_get(id=id)
    corrections.trial_failure(user=request.auth, trial=trial, **given.model_dump())
    return TrialDetail.of(selectors.trial_get(id=id), visibility_for_request(request))


@router.post("/{int:id}/void", response={200: TrialDetail, **FAILURES}, summary="Void it", url_name="void")
def void(request: HttpRequest, id: int, given: Reason) -> Any:
    """Void the trial, with a reason; it is then repeated as another attempt. Requires an operator.

    A scored trial of a blind plan becomes void_asked until a second blind operator answers; without an answer within 14
    days, or at the reveal, it counts.
    """
    voids.void_trial(user=request.auth, trial=selectors.trial_get(id=id), reason=given.reason)
    return TrialDetail.of(selectors.trial_get(id=id), visibility_for_request(request))


@router.post(
    "/{int:id}/void/answer",
    response={200: TrialDetail, **FAILURES},
    summary="Answer a void",
    url_name="void_answer",
)
def void_answer(request: HttpRequest, id: int, given: VoidAnswer) -> Any:
    """Agree to a void that another operator requested, or decline it with a reason. Requires a blind operator."""
    trial = selectors.trial_get(id=id)
    voids.answer_void(user=request.auth, trial=trial, agree=given.agree, reason=given.reason)
    return TrialDetail.of(selectors.trial_get(id=id), visibility_for_request(request))


@router.post(
    "/{int:id}/abandon", response={200: TrialDetail, **FAILURES}, summary="Give it up", url_name="abandon"
)
def abandon(request: HttpRequest, id: int, given: Reason) -> Any:
    """Give up a trial that never ran. Requires an operator."""
    services.abandon_trial(user=request.auth, trial=selectors.trial_get(id=id), reason=given.reason)
    return TrialDetail.of(selectors.trial_get(id=id), visibility_for_request(request))


def _csv_pages(pages: Iterator[list[Trial]], visibility: Visibility) -> Iterator[list[dict[str, Any]]]:
    for page in pages:
        yield [_csv_row(trial, visibility) for trial in page]


def _csv_row(trial: Trial, visibility: Visibility) -> dict[str, Any]:
    outcomes = list(trial.verdict.outcomes.all()) if trial.verdict else []
    return {
        **TrialOut.of(trial, visibility),
        "milestones_reached": "; ".join(outcome.text for outcome in outcomes if outcome.reached),
        "milestones_missed": "; ".join(outcome.text for outcome in outcomes if not outcome.reached),
    }
