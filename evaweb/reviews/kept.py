"""The lines of DATA/reviews/<uuid>.jsonl: written before the row, and read back where the row is lost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal
from uuid import UUID

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from evaweb.episodes.publishing import read_scores
from evaweb.errors import EvaError
from evaweb.reviews.folders import reviews_file
from evaweb.reviews.models import Review, Segment

_User = Annotated[str, Field(min_length=1, max_length=150)]
_Frame = Annotated[int, Field(ge=0, lt=2**31)]


class _Read(BaseModel):
    """Plain JSON that was written by this program; fields that it does not know are left alone."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class KeptReview(_Read):
    """A verdict, or a note."""

    kind: Literal["review"]
    uuid: UUID
    verdict: Literal["pass", "fail", "note"]
    note: str = ""
    by: _User
    at: AwareDatetime


class KeptSegment(_Read):
    """A part of the episode as it was from then on."""

    kind: Literal["segment"]
    uuid: UUID
    first: _Frame
    last: _Frame
    label: Annotated[str, Field(min_length=1, max_length=120)]
    milestone: Annotated[str, Field(max_length=200)] = ""
    by: _User
    at: AwareDatetime


class KeptRemoval(_Read):
    """A part that somebody took away again."""

    kind: Literal["segment_removed"]
    uuid: UUID
    by: _User
    at: AwareDatetime


Line = KeptReview | KeptSegment | KeptRemoval
_LINE: TypeAdapter[Line] = TypeAdapter(Annotated[Line, Field(discriminator="kind")])


def review_line(review: Review) -> dict[str, Any]:
    """The line of a review that is about to be saved."""
    return {
        "kind": "review",
        "uuid": str(review.uuid),
        "verdict": str(review.verdict),
        "note": review.note,
        "by": review.reviewer.get_username(),
        "at": review.at.isoformat(),
    }


def segment_line(segment: Segment) -> dict[str, Any]:
    """The line of a segment that is about to be saved."""
    return {
        "kind": "segment",
        "uuid": str(segment.uuid),
        "first": segment.first,
        "last": segment.last,
        "label": segment.label,
        "milestone": segment.milestone,
        "by": segment.annotator.get_username(),
        "at": segment.at.isoformat(),
    }


def removal_line(segment: Segment, by: Any, at: Any) -> dict[str, Any]:
    """The line of a segment that is about to be removed."""
    return {
        "kind": "segment_removed",
        "uuid": str(segment.uuid),
        "by": by.get_username(),
        "at": at.isoformat(),
    }


def kept_lines(uuid: UUID) -> list[Line]:
    """What the file of an episode says, oldest first; a torn line never counted. EvaError names one that is wrong."""
    lines = read_scores(reviews_file(uuid)).lines
    return [_line(line, number) for number, line in enumerate(lines, start=1)]


def _line(line: Mapping[str, Any], number: int) -> Line:
    try:
        return _LINE.validate_python(line)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "kind"
        raise EvaError(
            f"line {number} of its reviews: {place} is {first['input']!r:.80}: {first['msg']}"
        ) from None


def segments_of(lines: Sequence[Line]) -> list[KeptSegment]:
    """The segments that stand after all lines, in the order of their frames."""
    found: dict[UUID, KeptSegment] = {}
    for line in lines:
        if isinstance(line, KeptSegment):
            found[line.uuid] = line
        elif isinstance(line, KeptRemoval):
            found.pop(line.uuid, None)
    return sorted(found.values(), key=lambda segment: (segment.first, segment.last, segment.at))
