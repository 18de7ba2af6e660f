"""Schemas and sentences shared by all answers: errors, pages of rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Generic, TypeVar

from django.db.models import QuerySet
from ninja import Field, Schema
from pydantic import ConfigDict

Row = TypeVar("Row")
MAX_PAGE_SIZE = 1000
_WRAPPERS = ("given", "filters", "paging")  # view parameters that stand for the whole query or body
_MOST_SAID = 10  # errors listed per request


class ErrorOut(Schema):
    """Reason of a refusal: a sentence for people, and its id and arguments for pages in other languages.

    Sentences from elsewhere, such as the operating system, have neither.
    """

    error: str
    id: str | None = None
    arguments: dict[str, Any] | None = None


class Body(Schema):
    """Base of request bodies; unknown fields are refused, because a misspelt field would have no effect."""

    model_config = ConfigDict(extra="forbid")


class Page(Schema, Generic[Row]):
    """One page of rows; `total` counts all rows that match the filters."""

    total: int
    limit: int
    offset: int
    items: list[Row]


class Paging(Schema):
    """Range of rows to return."""

    limit: Annotated[int, Field(ge=1, le=MAX_PAGE_SIZE)] = 100
    offset: Annotated[int, Field(ge=0, le=2**53)] = 0

    def page(self, rows: QuerySet[Any], shape: Any, *seen: Any) -> dict[str, Any]:
        """Return total, limit, offset and the items of one page, converted by `shape.of(row, *seen)`."""
        selected = rows[self.offset : self.offset + self.limit]
        return {
            "total": rows.count(),
            "limit": self.limit,
            "offset": self.offset,
            "items": [shape.of(row, *seen) for row in selected],
        }


FAILURES = {frozenset({400, 401, 403, 404, 409, 422, 503}): ErrorOut}


def describe_errors(faults: Sequence[Mapping[str, Any]]) -> str:
    """Return pydantic's errors as one text: for each the place, the given value, and what is allowed."""
    sentences = [_sentence(fault) for fault in faults[:_MOST_SAID]]
    more = len(faults) - len(sentences)
    return "; ".join(sentences) + (f"; and {more} more" if more > 0 else "")


def _sentence(fault: Mapping[str, Any]) -> str:
    place = ".".join(str(part) for part in fault["loc"] if part not in _WRAPPERS) or "body"
    value = fault["input"]
    value_text = f" = {value!r:.80}" if isinstance(value, str | int | float) else ""
    msg = "unknown field" if fault["type"] == "extra_forbidden" else fault["msg"]
    return f"{place}{value_text}: {msg}"
