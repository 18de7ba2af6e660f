"""Records of trials: columns with their storage, display and visibility; journal lines of their scores and voids.

`TrialRecord` declares every column once. Manifests, scores files, restoring, REST, CSV, Parquet and result tables are
derived from it. To add a column, add a field to models.Trial and one to `TrialRecord` (docs/contributing.md).
"""

from __future__ import annotations

import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Any, Literal, Union, get_args, get_origin
from uuid import UUID

from pydantic import Field, StrictBool, field_validator

from evaweb.blinding.visibility import HIDDEN, Visibility, code_of
from evaweb.records.journal import (
    Journal,
    Line,
    Moment,
    Person,
    RowPath,
    parse_model,
    resolve_path,
)
from evaweb.stations.models import STATION_NAME
from evaweb.trials.models import Evaluation, Score, Trial, TrialStatus

Name = Annotated[str, Field(min_length=1, max_length=120)]
_Count = Annotated[int, Field(ge=0, lt=2**31)]
_Small = Annotated[int, Field(ge=0, lt=2**15)]
_Seconds = Annotated[float, Field(ge=0, le=1e9)]


@dataclass(frozen=True, slots=True)
class Column(RowPath):
    """Declaration of one column; `path` is its query path from a trial, or "" if that is the field's own name.

    While a trial's checkpoint is hidden from a user, a column is hidden too, unless it is `always_visible` or has a
    `masked_value`.
    """

    path: str = ""
    always_visible: bool = False  # it reveals nothing about the checkpoint
    masked_value: Callable[[Visibility, Trial], Any] | None = None
    written: Literal["before", "after", "never"] = (
        "before"  # relative to the run; manifests have the columns written before it
    )
    api: Literal["list", "detail", "never"] = "list"  # "list" includes CSV and Parquet
    table: bool = True  # part of a plan's result tables
    type: Any = None  # displayed type; None: the type when read
    label: str = ""  # label on the trial's page; "" if it is shown elsewhere or not at all

    def shown(self, name: str, hint: Any, trial: Trial, sight: Visibility) -> Any:
        """Return the column's value for a trial, as this user may see it."""
        if self.masked_value is not None:
            return self.masked_value(sight, trial)
        if self.always_visible or not sight.hides(trial):
            return resolve_path(trial, self.path or name)
        return None if type(None) in get_args(hint) else HIDDEN


class TrialRecord(Line):
    """Record of a trial, with columns in display order.

    Some columns are never written to files. In a record that was read from a file, these columns are None or "".
    """

    id: Annotated[
        Annotated[int, Field(gt=0, lt=2**53)] | None, Column("pk", always_visible=True, type=int)
    ] = None
    uuid: Annotated[UUID, Column(always_visible=True)]
    evaluation: Annotated[Name, Column("evaluation__name", always_visible=True, table=False)]
    evaluation_kind: Annotated[
        Evaluation.Kind, Column("evaluation__kind", always_visible=True, api="never", table=False)
    ] = Evaluation.Kind.OPEN_BENCH  # type: ignore[assignment]
    version: Annotated[_Count, Column("evaluation_version", always_visible=True, table=False)]
    station: Annotated[str, Field(pattern=STATION_NAME), Column("station__name", always_visible=True)]
    simulated: Annotated[
        StrictBool, Column("station__simulated", always_visible=True, api="never", table=False)
    ] = False
    scene: Annotated[
        str,
        Field(min_length=1, max_length=60, pattern=r"^[-\w]+$"),
        Column("scene__name", always_visible=True),
    ]
    position: Annotated[_Small, Column("position__number", always_visible=True)]
    checkpoint: Annotated[Name, Column("checkpoint__name", masked_value=Visibility.checkpoint_label)]
    code: Annotated[
        str, Column("handout__code", masked_value=lambda sight, trial: code_of(trial), written="never")
    ] = ""
    number: Annotated[_Count, Column(always_visible=True)]
    attempt: Annotated[_Small, Column(always_visible=True)]
    status: Annotated[TrialStatus | None, Column(always_visible=True, written="never", type=TrialStatus)] = (
        None
    )
    reason: Annotated[str, Column(masked_value=Visibility.reason, written="after")] = ""
    success: Annotated[bool | None, Column("verdict__success", always_visible=True, written="never")] = None
    score: Annotated[float | None, Column("verdict__score", always_visible=True, written="never")] = None
    duration_s: Annotated[_Seconds | None, Column(always_visible=True, written="after")] = None
    note: Annotated[str | None, Column("verdict__note", always_visible=True, written="never")] = None
    failure: Annotated[str | None, Column("verdict__failure", always_visible=True, written="never")] = None
    failure_phase: Annotated[
        str | None, Column("verdict__failure_phase", always_visible=True, written="never")
    ] = None
    rater: Annotated[str | None, Column("verdict__rater__username", always_visible=True, written="never")] = (
        None
    )
    source: Annotated[str | None, Column("verdict__source", always_visible=True, written="never")] = None
    scored_at: Annotated[
        datetime | None, Column("verdict__scored_at", always_visible=True, written="never")
    ] = None
    operator: Annotated[str, Field(max_length=150), Column("operator__username", always_visible=True)] = ""
    instruction: Annotated[str, Column(always_visible=True, table=False)]
    seed: Annotated[_Count | None, Column(always_visible=True, table=False)] = None
    worker: Annotated[str | None, Field(max_length=60), Column(always_visible=True, table=False)] = None
    strategy: Annotated[dict[str, Any] | None, Column(api="never", table=False)] = None
    time_limit_s: Annotated[_Seconds | None, Column(always_visible=True, table=False)] = None
    prepared_at: Annotated[Moment | None, Column(always_visible=True, table=False, type=datetime)] = None
    started_at: Annotated[Moment | None, Column(always_visible=True, written="after")] = None
    ended_at: Annotated[Moment | None, Column(always_visible=True, written="after")] = None
    ended_by: Annotated[
        str | None,
        Field(max_length=14),
        Column(always_visible=True, written="after", api="never", table=False),
    ] = None
    episode: Annotated[UUID | None, Column("episode_id", always_visible=True, written="never")] = None
    truth: Annotated[
        dict[str, Any] | None, Column(always_visible=True, written="after", api="detail", table=False)
    ] = None
    voided_by: Annotated[
        str | None,
        Column("voided_by__username", always_visible=True, written="never", api="detail", table=False),
    ] = None
    voided_at: Annotated[
        datetime | None, Column(always_visible=True, written="never", api="detail", table=False)
    ] = None

    @classmethod
    def names(cls) -> Iterable[str]:
        """Return the names of the columns that are written to disk."""
        return [name for name, column in COLUMNS.items() if column.written != "never"]

    @classmethod
    def for_manifest(cls, trial: Trial) -> dict[str, Any]:
        """Return the columns of a trial that are known before its run, for the episode's manifest.

        The trial's uuid is among these columns, and is unique across databases.
        """
        whole = cls.written(trial)
        return {name: value for name, value in whole.items() if COLUMNS[name].written == "before"}

    def pre_run_fields(self) -> dict[str, Any]:
        """Return the fields of models.Trial known before the run, without its id and foreign keys."""
        return self._fields("before")

    def run_fields(self) -> dict[str, Any]:
        """Return the fields of models.Trial that the run determines."""
        return self._fields("after")

    def _fields(self, when: str) -> dict[str, Any]:
        mine = {name: self.path_of(name) for name, column in COLUMNS.items() if column.written == when}
        return {path: getattr(self, name) for name, path in mine.items() if path != "pk" and "__" not in path}


COLUMNS: Mapping[str, Column] = {
    name: next(each for each in field.metadata if isinstance(each, Column))
    for name, field in TrialRecord.model_fields.items()
}


def _shown_as(annotation: Any) -> Any:
    """Return a type without its validation metadata."""
    if get_origin(annotation) is Annotated:
        return _shown_as(get_args(annotation)[0])
    if get_origin(annotation) in (Union, types.UnionType):
        return Union[tuple(map(_shown_as, get_args(annotation)))]  # noqa: UP007  made of a list
    return annotation


HINTS: Mapping[str, Any] = {
    name: column.type or _shown_as(TrialRecord.model_fields[name].annotation)
    for name, column in COLUMNS.items()
}
"""Displayed types of the columns."""


def api_columns(where: Literal["list", "detail"]) -> dict[str, Any]:
    """Return the REST columns with their types.

    "list" are those in lists of trials, "detail" those that only the response for a single trial adds.
    """
    return {name: HINTS[name] for name, column in COLUMNS.items() if column.api == where}


def visible_columns(trial: Trial, sight: Visibility, names: Iterable[str]) -> dict[str, Any]:
    """Return the named columns of a trial as this user may see them."""
    return {name: COLUMNS[name].shown(name, HINTS[name], trial, sight) for name in names}


def visible_labels(trial: Trial, sight: Visibility) -> Iterator[tuple[str, Any]]:
    """Yield label and value of the columns on the trial's page, as this user may see them."""
    for name, column in COLUMNS.items():
        if column.label:
            yield column.label, column.shown(name, HINTS[name], trial, sight)


# --- DATA/scores/<uuid>.jsonl: scores and voids of an episode, or of a trial without a recording -----------------


class OutcomeLine(Line):
    """Milestone in a score's journal line, as it was at scoring time."""

    order: _Small
    text: Annotated[str, Field(max_length=200)]
    points: _Small
    required: StrictBool
    reached: StrictBool
    at_s: _Seconds | None = None


class ScoreLine(Line):
    """Journal line of a score of a trial."""

    kind: Literal["score"] = "score"
    uuid: UUID
    trial: TrialRecord
    rater: Annotated[Person, RowPath("rater__username")]
    at: Annotated[Moment, RowPath("scored_at")]
    success: StrictBool
    score: Annotated[float, Field(ge=0, le=1)]
    note: str = ""
    failure: Annotated[str, Field(max_length=60)] = ""
    failure_phase: Annotated[str, Field(max_length=60)] = ""
    reason: str = ""
    source: Score.Source = Score.Source.HUMAN  # type: ignore[assignment]
    milestones: Annotated[tuple[OutcomeLine, ...], RowPath("outcomes__all")] = ()

    @field_validator("milestones")
    @classmethod
    def _once(cls, milestones: tuple[OutcomeLine, ...]) -> tuple[OutcomeLine, ...]:
        if len({milestone.order for milestone in milestones}) < len(milestones):
            raise ValueError("allowed: each milestone once")
        return milestones


class VoidLine(Line):
    """Journal line of a void of a trial."""

    kind: Literal["void"] = "void"
    trial: TrialRecord
    by: Annotated[Person, RowPath("voided_by__username")]
    reason: str
    at: Annotated[Moment, RowPath("voided_at")]

    @classmethod
    def written(cls, row: Trial, **given: Any) -> dict[str, Any]:
        """Return the line of a trial that is about to be saved as voided."""
        return super().written(row, trial=TrialRecord.written(row), **given)


class VoidRequestLine(Line):
    """Journal line of an operator's request to void a trial."""

    kind: Literal["void_request"] = "void_request"
    uuid: UUID
    trial: TrialRecord
    by: Annotated[Person, RowPath("by__username")]
    reason: str
    at: Moment


class VoidAnswerLine(Line):
    """Journal line of the answer to a void request.

    `at` is when it was answered, or when it lapsed through a user's action.
    """

    ELSEWHERE = frozenset({"kind", "uuid"})
    kind: Literal["void_answer"] = "void_answer"
    uuid: UUID  # uuid of the request
    trial: TrialRecord
    answer: Annotated[str, Field(pattern="^(agreed|refused|lapsed)$")]
    reason: Annotated[str, RowPath("answer_reason")] = ""
    by: Annotated[Person, RowPath("answered_by__username")]
    at: Annotated[Moment, RowPath("answered_at")]


Judgement = ScoreLine | VoidLine | VoidRequestLine | VoidAnswerLine
JUDGEMENTS: Journal[Judgement] = Journal("scores", ScoreLine, VoidLine, VoidRequestLine, VoidAnswerLine)


def journal_uuid(trial: Trial) -> UUID:
    """Return the uuid that names the file of a trial's scores: its episode's, or its own."""
    return trial.episode_id or trial.uuid


def trial_of_manifest(asked: Mapping[str, Any]) -> TrialRecord | None:
    """Return the trial that a manifest names; None if the run has no trial of this lab."""
    return parse_model(TrialRecord, asked, "the manifest's trial") if "uuid" in asked else None
