"""Trials: the list, one, and what is done with one."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from typing import Annotated, Any
from uuid import UUID

from django.http import HttpRequest
from ninja import Field, Query, Router, Schema

from evaweb.api.answers import FAILURES, Page, Paging
from evaweb.api.tables import Format, table_answer
from evaweb.blinding import Sight, code_of, sight_for
from evaweb.trials import selectors, services
from evaweb.trials.models import Score, Trial, TrialStatus
from evaweb.trials.selectors import TrialFilters

router = Router(tags=["trials"])


class Filters(Schema):
    """Which trials are meant: each by name (or id), all of them together."""

    evaluation: str = ""
    checkpoint: str = ""
    scene: str = ""
    station: str = ""
    status: Annotated[str, Field(description=f"One of {', '.join(TrialStatus.values)}")] = ""
    since: Annotated[str, Field(description="Prepared on or after this day or time, ISO 8601")] = ""

    def chosen(self) -> TrialFilters:
        """As the selectors take them."""
        return TrialFilters(**self.model_dump())


class TrialOut(Schema):
    """One attempt, flat; success, score, note and rater are those of the newest score.

    `code` is what a trial of a plan was handed out under, "" for others. While it is hidden from the caller which
    `checkpoint` it is of, the code stands there too.
    """

    id: int
    uuid: UUID
    evaluation: str
    version: int
    station: str
    scene: str
    position: int
    checkpoint: str
    code: str
    number: int
    attempt: int
    status: TrialStatus
    reason: str
    success: bool | None
    score: float | None
    duration_s: float | None
    note: str | None
    failure: str | None
    rater: str | None
    source: str | None
    scored_at: datetime | None
    operator: str
    instruction: str
    seed: int | None
    time_limit_s: float | None
    prepared_at: datetime
    started_at: datetime | None
    ended_at: datetime | None
    episode: UUID | None

    @staticmethod
    def of(trial: Trial, sight: Sight) -> dict[str, Any]:
        """Flat, the same for JSON and CSV."""
        plain = ("id", "uuid", "number", "attempt", "status", "duration_s", "instruction", "seed")
        times = ("time_limit_s", "prepared_at", "started_at", "ended_at")
        newest = ("success", "score", "note", "failure", "source", "scored_at")
        return {
            **{name: getattr(trial, name) for name in (*plain, *times)},
            **{name: getattr(trial.verdict, name, None) for name in newest},
            "evaluation": trial.evaluation.name,
            "version": trial.evaluation_version,
            "station": trial.station.name,
            "scene": trial.scene.name,
            "position": trial.position.number,
            "checkpoint": sight.label(trial),
            "code": code_of(trial),
            "reason": sight.reason(trial),
            "operator": trial.operator.get_username(),
            "rater": trial.verdict.rater.get_username() if trial.verdict else None,
            "episode": trial.episode_id,
        }


class OutcomeOut(Schema):
    """A milestone as it was when it was scored."""

    order: int
    text: str
    points: int
    required: bool
    reached: bool
    at_s: float | None


class ScoreOut(Schema):
    """One rater's score; the newest one counts, none is ever changed."""

    uuid: UUID
    rater: str
    source: str
    success: bool
    score: float
    note: str
    failure: str
    reason: str
    scored_at: datetime
    milestones: list[OutcomeOut]

    @staticmethod
    def of(score: Score) -> dict[str, Any]:
        """With its milestones."""
        plain = ("uuid", "source", "success", "score", "note", "failure", "reason", "scored_at")
        return {
            **{name: getattr(score, name) for name in plain},
            "rater": score.rater.get_username(),
            "milestones": list(score.outcomes.all()),
        }


class TrialDetail(TrialOut):
    """A trial with all its scores, the newest first, and what a simulated bench says of its end."""

    scores: list[ScoreOut]
    truth: dict[str, Any] | None
    voided_by: str | None
    voided_at: datetime | None

    @staticmethod
    def of(trial: Trial, sight: Sight) -> dict[str, Any]:
        """With all that is known of it."""
        return {
            **TrialOut.of(trial, sight),
            "scores": [ScoreOut.of(score) for score in trial.scores.all()],
            "truth": trial.truth,
            "voided_by": trial.voided_by.get_username() if trial.voided_by else None,
            "voided_at": trial.voided_at,
        }


class ScoreIn(Schema):
    """A score: every milestone of the scene by id; `success` only where none of them is required.

    A trial that has a score takes another one as a correction, with a `reason`. After a lost answer a client sends the
    same again: with its `uuid`, or word by word, it is the first score once more.
    """

    milestones: Annotated[dict[str, bool], Field(default_factory=dict)]
    times: Annotated[
        dict[str, float | None],
        Field(default_factory=dict, description="When each was reached, s after the start of the run"),
    ]
    success: bool | None = None
    note: str = ""
    failure: str = ""
    source: str = Score.Source.HUMAN.value
    reason: str = ""
    uuid: Annotated[UUID | None, Field(description="Of your own; another one for each score")] = None


class Reason(Schema):
    """Reason, for later readers."""

    reason: str = ""


COLUMNS: dict[str, Any] = {
    **{name: field.annotation for name, field in TrialOut.model_fields.items()},
    "milestones_reached": str,
    "milestones_missed": str,
}


@router.get("", response={200: Page[TrialOut], **FAILURES}, summary="Trials", url_name="trials")
def trials(
    request: HttpRequest, filters: Query[Filters], paging: Query[Paging], format: Format = "json"
) -> Any:
    """The newest first, in pages; with `format=csv` or `parquet` all that fit, the oldest first."""
    seen = sight_for(request)
    if format != "json":
        pages = selectors.trials_in_pages(filters.chosen(), sight=seen)
        return table_answer(request, "trials", COLUMNS, _csv_pages(pages, seen), format)
    return paging.of(selectors.trial_list(filters.chosen(), seen), TrialOut, seen)


@router.get("/{int:id}", response={200: TrialDetail, **FAILURES}, summary="One trial", url_name="trial")
def trial(request: HttpRequest, id: int) -> Any:
    """With every score it was ever given."""
    return TrialDetail.of(selectors.trial_get(id=id), sight_for(request))


@router.post("/{int:id}/score", response={200: TrialDetail, **FAILURES}, summary="Score it", url_name="score")
def score(request: HttpRequest, id: int, given: ScoreIn) -> Any:
    """Add a score, or a correction; operators."""
    found = selectors.trial_get(id=id)
    services.trial_score(user=request.auth, trial=found, **given.model_dump())
    return TrialDetail.of(selectors.trial_get(id=id), sight_for(request))


@router.post("/{int:id}/void", response={200: TrialDetail, **FAILURES}, summary="Void it", url_name="void")
def void(request: HttpRequest, id: int, given: Reason) -> Any:
    """Take it out of the count, with a reason; operators. Its repetition is another attempt."""
    services.trial_void(user=request.auth, trial=selectors.trial_get(id=id), reason=given.reason)
    return TrialDetail.of(selectors.trial_get(id=id), sight_for(request))


@router.post(
    "/{int:id}/abandon", response={200: TrialDetail, **FAILURES}, summary="Give it up", url_name="abandon"
)
def abandon(request: HttpRequest, id: int, given: Reason) -> Any:
    """Give up a trial that never ran; operators."""
    services.trial_abandon(user=request.auth, trial=selectors.trial_get(id=id), reason=given.reason)
    return TrialDetail.of(selectors.trial_get(id=id), sight_for(request))


def _csv_pages(pages: Iterator[list[Trial]], sight: Sight) -> Iterator[list[dict[str, Any]]]:
    for page in pages:
        yield [_csv_row(trial, sight) for trial in page]


def _csv_row(trial: Trial, sight: Sight) -> dict[str, Any]:
    outcomes = list(trial.verdict.outcomes.all()) if trial.verdict else []
    return {
        **TrialOut.of(trial, sight),
        "milestones_reached": "; ".join(outcome.text for outcome in outcomes if outcome.reached),
        "milestones_missed": "; ".join(outcome.text for outcome in outcomes if not outcome.reached),
    }
