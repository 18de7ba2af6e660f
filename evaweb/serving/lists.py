"""Lists on pages: filter and sort order are in the URL, and the CSV file has the same rows.

A page declares the columns and filters of its list; templates/lists and static/site/lists.js render them.
Data hidden from a user must not be offered as a sort column or a filter choice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from django.core.paginator import Page, Paginator
from django.db.models import F, QuerySet
from django.http import HttpRequest, QueryDict, StreamingHttpResponse

from evaweb.core.errors import EvaError
from evaweb.core.tabular_export import iter_csv
from evaweb.serving.downloads import CSV, download
from runtime.core.sentences import Pattern

_SORT_ALLOWED_EACH_ALSO_WITH = Pattern(
    "web.lists.sort_allowed_each_also_with",
    "sort = {value!r:.80}; allowed: {known}, each also with - in front",
)

_CHARACTERS_ALLOWED = Pattern(
    "web.lists.characters_allowed", "{name} has {count} characters; allowed: at most {most}"
)
_WORDS_ALLOWED = Pattern(
    "web.lists.words_allowed", "{name} has {count} different words; allowed: at most {most}"
)

SEARCH, CHOICE, DAY, UNSEEN = "search", "choice", "day", "unseen"
LONGEST = 200  # longest search text [characters]
_MOST_WORDS = 16  # search words; each adds a condition to the query
_AT_ONCE = 500  # rows read at a time for a file


@dataclass(frozen=True, slots=True)
class Column:
    """Column of a list.

    `by`: fields of a query, or attributes, to sort by; () if not sortable. `cell` returns the value in the CSV file.
    `down`: descending is the first sort order. `quiet`: the title is for screen readers only.
    `hidden`: the column is in the file only.
    """

    name: str
    title: str
    by: tuple[str, ...] = ()
    cell: Callable[[Any], object] | None = None
    number: bool = False
    down: bool = False
    quiet: bool = False
    hidden: bool = False


@dataclass(frozen=True, slots=True)
class Filter:
    """Filter of a list: one of `choices` (pairs of value and label), or a typed text.

    `any` is the label for not filtering. If not `strict`, values that are not among the choices are reported by the
    page itself. A filter of kind UNSEEN has no input field and is set by links.
    """

    name: str
    label: str
    choices: Sequence[tuple[str, str]] = ()
    kind: str = CHOICE
    hint: str = ""
    any: str = "all"
    strict: bool = True


@dataclass(frozen=True, slots=True)
class Head:
    """Header of a column.

    `next` is the sort parameter that a click on the header sets; None sets the default order. `sorted` is the value of
    the header's attribute aria-sort, "" if the list is not sorted by this column.
    """

    column: Column
    next: str | None
    sorted: str


@dataclass(frozen=True, slots=True)
class Chip:
    """An active filter as text; `without` is the query string without it."""

    words: str
    without: str


def words_of(text: str, name: str = "words") -> list[str]:
    """Return the distinct search words of `text`. Raises: EvaError if the text is too long or has too many."""
    if len(text) > LONGEST:
        raise EvaError(_CHARACTERS_ALLOWED(name=name, count=len(text), most=LONGEST))
    parts = list(dict.fromkeys(text.split()))
    if len(parts) > _MOST_WORDS:
        raise EvaError(_WORDS_ALLOWED(name=name, count=len(parts), most=_MOST_WORDS))
    return parts


class Listing:
    """A list as its URL requests it; if the request is invalid, `fault` is the reason and everything is shown."""

    def __init__(self, given: QueryDict, columns: Sequence[Column], filters: Sequence[Filter] = ()) -> None:
        self.columns, self.filters, self.fault, self._given = columns, filters, "", given
        self.number = given.get("page")
        self.wants_file = given.get("format") == "csv"
        try:
            self.chosen = {
                entry.name: self._value(entry, given.get(entry.name, "").strip()) for entry in filters
            }
            self.sort = self._sort(given.get("sort", ""))
        except EvaError as fault:
            self.refuse(fault)

    def refuse(self, fault: EvaError) -> None:
        """Reset filters and sort order, and record the reason."""
        self.fault, self.sort = str(fault), ""
        self.chosen = {entry.name: "" for entry in self.filters}

    def _value(self, entry: Filter, value: str) -> str:
        keys = [key for key, _ in entry.choices]
        if value and entry.kind == CHOICE and entry.strict and value not in keys:
            raise EvaError(f"{entry.name} = {value!r:.80}; allowed: {', '.join(keys) or 'nothing yet'}")
        if entry.kind == SEARCH:
            words_of(value, entry.name)
        return value

    def _sort(self, value: str) -> str:
        names = [column.name for column in self.columns if column.by]
        if value and value.removeprefix("-") not in names:
            raise EvaError(_SORT_ALLOWED_EACH_ALSO_WITH(value=value, known=", ".join(names)))
        return value

    # --- as it is shown ----------------------------------------------------------------------------------------

    @property
    def heads(self) -> list[Head]:
        """Headers of all visible columns."""
        return [self._head(column) for column in self.columns if not column.hidden]

    def _head(self, column: Column) -> Head:
        up, down = column.name, f"-{column.name}"
        first, second = (down, up) if column.down or column.number else (up, down)
        state = {up: "ascending", down: "descending"}.get(self.sort, "") if column.by else ""
        return Head(column, {first: second, second: None}.get(self.sort, first), state)

    @property
    def chips(self) -> list[Chip]:
        """Active filters."""
        return [
            Chip(f"{entry.label}: {dict(entry.choices).get(value, value)}", self._without(entry.name))
            for entry in self.filters
            if (value := self.chosen[entry.name])
        ]

    def _without(self, name: str) -> str:
        left = self._given.copy()
        for key in (name, "page"):
            left.pop(key, None)
        return left.urlencode()

    @property
    def fields(self) -> list[tuple[Filter, str]]:
        """Filters, each with its chosen value."""
        return [(entry, self.chosen[entry.name]) for entry in self.filters]

    # --- its rows ----------------------------------------------------------------------------------------------

    def ordered(self, rows: QuerySet[Any]) -> QuerySet[Any]:
        """Return `rows` in the chosen order with NULL last; unchanged if no order is chosen."""
        if not self.sort:
            return rows
        down = self.sort.startswith("-")
        fields = [F(field) for field in self._by]
        return rows.order_by(
            *(
                expression.desc(nulls_last=True) if down else expression.asc(nulls_last=True)
                for expression in fields
            ),
            "-pk" if down else "pk",
        )

    def page(self, rows: QuerySet[Any], size: int) -> Page[Any]:
        """Return one page of `rows`: only keys are sorted, and only the rows of the page are read in full."""
        keys = self.ordered(rows).values_list("pk", flat=True)
        page: Page[Any] = Paginator(keys, size).get_page(self.number)
        page.object_list = _in_order(rows, list(page.object_list))
        return page

    def sorted(self, rows: Sequence[Any]) -> list[Any]:
        """Return `rows` sorted by the attributes of the chosen column, None last."""
        if not self.sort:
            return list(rows)
        value = attrgetter(*self._by)
        valued = [row for row in rows if value(row) is not None]
        valued.sort(key=value, reverse=self.sort.startswith("-"))
        return valued + [row for row in rows if value(row) is None]

    @property
    def _by(self) -> tuple[str, ...]:
        name = self.sort.removeprefix("-")
        return next(column.by for column in self.columns if column.name == name)

    @property
    def has_file(self) -> bool:
        """Whether the list can be downloaded as a file."""
        return any(column.cell for column in self.columns)

    def file(
        self, request: HttpRequest, name: str, rows: QuerySet[Any] | Iterable[Any]
    ) -> StreamingHttpResponse:
        """Return all rows as the file `name`.csv: a queryset in the order of the list, other rows as they come.

        Raises:
            EvaError: The request is invalid; `fault` is the reason.
        """
        if self.fault:
            raise EvaError(self.fault)
        columns = {column.name: column.cell for column in self.columns if column.cell}
        pages = self._read(rows) if isinstance(rows, QuerySet) else iter([rows])
        cells = (({key: cell(row) for key, cell in columns.items()} for row in page) for page in pages)
        return download(request, iter_csv(list(columns), cells), f"{name}.csv", CSV)

    def _read(self, rows: QuerySet[Any]) -> Iterator[list[Any]]:
        keys = list(self.ordered(rows).values_list("pk", flat=True))
        for first in range(0, len(keys), _AT_ONCE):
            yield _in_order(rows, keys[first : first + _AT_ONCE])


def _in_order(rows: QuerySet[Any], keys: Sequence[Any]) -> list[Any]:
    by_key: Mapping[Any, Any] = rows.order_by().in_bulk(keys)
    return [by_key[key] for key in keys if key in by_key]  # rows may have been deleted meanwhile
