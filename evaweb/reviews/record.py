"""Lines of DATA/reviews/<uuid>.jsonl: verdicts, notes, segments and tags."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal
from uuid import UUID

from pydantic import Field, ValidationInfo, field_validator

from evaweb.episodes.folders import data_dir
from evaweb.records.journal import (
    Journal,
    Line,
    Moment,
    Person,
    RowPath,
)


def report_file(uuid: UUID) -> Path:
    """Return the file of an episode's quality report."""
    return data_dir() / "quality" / f"{uuid}.json"


def bounds_file() -> Path:
    """Return the file with this lab's own bounds for quality checks of all episodes."""
    return data_dir() / "quality.toml"


_Frame = Annotated[int, Field(ge=0, lt=2**31)]


class ReviewLine(Line):
    """Journal line of a verdict or a note."""

    kind: Literal["review"] = "review"
    uuid: UUID
    verdict: Literal["pass", "fail", "note"]
    note: str = ""
    frame: _Frame | None = None
    by: Annotated[Person, RowPath("reviewer__username")]
    at: Moment


class SegmentLine(Line):
    """Journal line with the values of a segment, valid until a later line of the same segment."""

    kind: Literal["segment"] = "segment"
    uuid: UUID
    first: _Frame
    last: _Frame
    label: Annotated[str, Field(min_length=1, max_length=120)]
    milestone: Annotated[str, Field(max_length=200)] = ""
    by: Annotated[Person, RowPath("annotator__username")]
    at: Moment

    @field_validator("last")
    @classmethod
    def _after_first(cls, last: int, info: ValidationInfo) -> int:
        if last < info.data.get("first", 0):
            raise ValueError("allowed: no frame before the first one")
        return last


class RemovalLine(Line):
    """Journal line of the removal of a segment."""

    kind: Literal["segment_removed"] = "segment_removed"
    uuid: UUID
    by: Person
    at: Moment


class TagLine(Line):
    """Journal line of a tag added to the episode."""

    kind: Literal["tag"] = "tag"
    uuid: UUID
    words: Annotated[str, Field(min_length=1, max_length=60)]
    by: Annotated[Person, RowPath("by__username")]
    at: Moment


class UntagLine(Line):
    """Journal line of the removal of a tag."""

    kind: Literal["tag_removed"] = "tag_removed"
    uuid: UUID
    by: Person
    at: Moment


AnyReview = ReviewLine | SegmentLine | RemovalLine | TagLine | UntagLine
REVIEWS: Journal[AnyReview] = Journal("reviews", ReviewLine, SegmentLine, RemovalLine, TagLine, UntagLine)


def tags_of(lines: Sequence[AnyReview]) -> list[TagLine]:
    """Return the tags of an episode after all lines have been applied.

    Of two tags with the same words, only the first is returned.
    """
    by_uuid: dict[UUID, TagLine] = {}
    for line in lines:
        if isinstance(line, TagLine):
            by_uuid[line.uuid] = line
        elif isinstance(line, UntagLine):
            by_uuid.pop(line.uuid, None)
    return list({line.words: line for line in reversed(by_uuid.values())}.values())


def segments_of(lines: Sequence[AnyReview]) -> list[SegmentLine]:
    """Return the segments that are left after all lines, sorted by frames."""
    by_uuid: dict[UUID, SegmentLine] = {}
    for line in lines:
        if isinstance(line, SegmentLine):
            by_uuid[line.uuid] = line
        elif isinstance(line, RemovalLine):
            by_uuid.pop(line.uuid, None)
    return sorted(by_uuid.values(), key=lambda segment: (segment.first, segment.last, segment.at))
