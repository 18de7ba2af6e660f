"""Second ratings, preferences and automatic judgements as lines of an episode's journal of scores.

Each episode has one such file, DATA/scores/UUID.jsonl. A rating or judgement is in the file of its trial's episode, a
preference in that of the trial that was run second. These files are never served.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal
from uuid import UUID

from pydantic import Field, StrictBool

from evaweb.records.journal import (
    Journal,
    Line,
    Moment,
    Person,
    RowPath,
)
from evaweb.results.models import Judgement, Preference, Rating
from evaweb.trials.record import Name, TrialRecord


class RatingLine(Line):
    """Journal line of a second rating."""

    kind: Literal["rating"] = "rating"
    uuid: UUID
    trial: TrialRecord
    rater: Annotated[Person, RowPath("rater__username")]
    at: Moment
    success: StrictBool
    score: Annotated[float, Field(ge=0, le=1)]
    milestones: tuple[tuple[str, StrictBool], ...] = ()
    failure: Annotated[str, Field(max_length=60)] = ""
    failure_phase: Annotated[str, Field(max_length=60)] = ""
    note: str = ""
    blind: StrictBool

    @classmethod
    def written(cls, row: Rating, **given: Any) -> dict[str, Any]:
        """Return the line of a rating that is about to be saved."""
        return super().written(row, trial=TrialRecord.for_manifest(row.trial), **given)


class PreferenceLine(Line):
    """Journal line of a preference; `plan` and `version` name its plan."""

    kind: Literal["preference"] = "preference"
    uuid: UUID
    plan: Annotated[Name, RowPath("plan__name")]
    version: Annotated[int, Field(ge=1, lt=2**31), RowPath("plan__version")]
    first: TrialRecord
    second: TrialRecord
    rater: Annotated[Person, RowPath("rater__username")]
    at: Moment
    outcome: Preference.Outcome
    why: str
    blind: StrictBool

    @classmethod
    def written(cls, row: Preference, **given: Any) -> dict[str, Any]:
        """Return the line of a preference that is about to be saved."""
        pair = {name: TrialRecord.for_manifest(getattr(row, name)) for name in ("first", "second")}
        return super().written(row, **pair, **given)


_Share = Annotated[float, Field(ge=0, le=1)]
_Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class JudgementLine(Line):
    """Journal line of an automatic judgement."""

    kind: Literal["judgement"] = "judgement"
    uuid: UUID
    trial: TrialRecord
    judge: Annotated[str, Field(min_length=1, max_length=60)]
    version: Annotated[str, Field(min_length=1, max_length=200)]
    model: Annotated[str, Field(max_length=200)] = ""
    at: Moment
    milestones: tuple[tuple[str, StrictBool | None, _Share | None], ...] = ()
    reason: str = ""
    prompt: _Digest | Literal[""] = ""
    pictures: tuple[tuple[str, float, _Digest], ...] = ()

    @classmethod
    def written(cls, row: Judgement, **given: Any) -> dict[str, Any]:
        """Return the line of a judgement that is about to be saved."""
        return super().written(row, trial=TrialRecord.for_manifest(row.trial), **given)


RATINGS: Journal[RatingLine | PreferenceLine | JudgementLine] = Journal(
    "scores", RatingLine, PreferenceLine, JudgementLine
)
