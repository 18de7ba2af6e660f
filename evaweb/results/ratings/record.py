"""Second ratings, preferences and what automatic judges said, as lines of an episode's own journal of verdicts.

They lie beside its scores, DATA/scores/UUID.jsonl: a rating or judgement with the trial that it is of, a preference
with the one that was run second, when the other one was there already. Nothing serves these files.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal
from uuid import UUID

from pydantic import Field, StrictBool

from evaweb.journal import Journal, Line, Moment, Person, RowPath
from evaweb.results.models import Judgement, Preference, Rating
from evaweb.trials.record import Name, TrialRecord


class RatingLine(Line):
    """A second rating."""

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
        """The line of a rating that is about to be saved."""
        return super().written(row, trial=TrialRecord.for_manifest(row.trial), **given)


class PreferenceLine(Line):
    """A preference; `plan` and `version` name the plan that it is of."""

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
        """The line of a preference that is about to be saved."""
        pair = {name: TrialRecord.for_manifest(getattr(row, name)) for name in ("first", "second")}
        return super().written(row, **pair, **given)


_Share = Annotated[float, Field(ge=0, le=1)]
_Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class JudgementLine(Line):
    """What an automatic judge said."""

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
        """The line of a judgement that is about to be saved."""
        return super().written(row, trial=TrialRecord.for_manifest(row.trial), **given)


RATINGS: Journal[RatingLine | PreferenceLine | JudgementLine] = Journal(
    "scores", RatingLine, PreferenceLine, JudgementLine
)
