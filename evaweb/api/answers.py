"""Shapes that all answers share: errors, pages of rows."""

from __future__ import annotations

from typing import Annotated, Any, Generic, TypeVar

from django.db.models import QuerySet
from ninja import Field, Schema

Row = TypeVar("Row")
LARGEST_PAGE = 1000


class Failure(Schema):
    """Why it was not done: a sentence for a person."""

    error: str


class Page(Schema, Generic[Row]):
    """Some rows of many; `total` counts all that fit the filters."""

    total: int
    limit: int
    offset: int
    items: list[Row]


class Paging(Schema):
    """Which of the rows are wanted."""

    limit: Annotated[int, Field(ge=1, le=LARGEST_PAGE)] = 100
    offset: Annotated[int, Field(ge=0, le=2**53)] = 0

    def of(self, rows: QuerySet[Any], shape: Any, *seen: Any) -> dict[str, Any]:
        """The page of `rows`, each through `shape.of`, which is also given what is `seen` of them."""
        found = rows[self.offset : self.offset + self.limit]
        return {
            "total": rows.count(),
            "limit": self.limit,
            "offset": self.offset,
            "items": [shape.of(row, *seen) for row in found],
        }


FAILURES = {frozenset({400, 401, 403, 404, 409, 422, 503}): Failure}
