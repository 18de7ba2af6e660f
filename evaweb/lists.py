"""Lists on pages: what one is narrowed to and sorted by stands in its address, and its file has the same rows.

A page says which columns and filters its list has; all of them are shown by templates/lists and static/site/lists.js.
What a user may not see is no column by which they sort, and no choice of a filter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from django.core.paginator import Page, Paginator
from django.db.models import F, QuerySet
from django.http import HttpRequest, QueryDict, StreamingHttpResponse

from evaweb.downloads import CSV, download
from evaweb.errors import EvaError
from evaweb.tabular_export import iter_csv
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
LONGEST = 200  # characters of words that are looked for
_MOST_WORDS = 16  # each is a condition of the query
_AT_ONCE = 500  # rows of a file


@dataclass(frozen=True, slots=True)
class Column:
    """A column: sorted `by` fields of a query, or attributes, none where it is not; `cell` is its text in the file.

    `down`: sorted from its largest value down first. `quiet`: its title is for those alone who do not see the page;
    `hidden`: it is in the file alone.
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
    """What a list is narrowed by: one of `choices`, pairs of value and words, or what is typed.

    `any` stands for no choice. Not `strict`: the page itself says what it does not know. Of the kind UNSEEN it has no
    field: links lead to it.
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
    """A column's head: the sort that it leads to, None for the list's own; `sorted`: as aria-sort has it."""

    column: Column
    next: str | None
    sorted: str


@dataclass(frozen=True, slots=True)
class Chip:
    """One thing that the list is narrowed to, in words; `without`: the query of the list without it."""

    words: str
    without: str


def words_of(text: str, name: str = "words") -> list[str]:
    """The words that are looked for, each once; EvaError where there are too many."""
    if len(text) > LONGEST:
        raise EvaError(_CHARACTERS_ALLOWED(name=name, count=len(text), most=LONGEST))
    words = list(dict.fromkeys(text.split()))
    if len(words) > _MOST_WORDS:
        raise EvaError(_WORDS_ALLOWED(name=name, count=len(words), most=_MOST_WORDS))
    return words


class Listing:
    """A list as its address asks for it; where that asks for what there is not, `fault` says so and all is shown."""

    def __init__(self, given: QueryDict, columns: Sequence[Column], filters: Sequence[Filter] = ()) -> None:
        self.columns, self.filters, self.fault, self._given = columns, filters, "", given
        self.number = given.get("page")
        self.wants_file = given.get("format") == "csv"
        try:
            self.chosen = {one.name: self._value(one, given.get(one.name, "").strip()) for one in filters}
            self.sort = self._sort(given.get("sort", ""))
        except EvaError as fault:
            self.refuse(fault)

    def refuse(self, fault: EvaError) -> None:
        """Show all, and why."""
        self.fault, self.sort = str(fault), ""
        self.chosen = {one.name: "" for one in self.filters}

    def _value(self, one: Filter, value: str) -> str:
        known = [key for key, _ in one.choices]
        if value and one.kind == CHOICE and one.strict and value not in known:
            raise EvaError(f"{one.name} = {value!r:.80}; allowed: {', '.join(known) or 'nothing yet'}")
        if one.kind == SEARCH:
            words_of(value, one.name)
        return value

    def _sort(self, value: str) -> str:
        known = [column.name for column in self.columns if column.by]
        if value and value.removeprefix("-") not in known:
            raise EvaError(_SORT_ALLOWED_EACH_ALSO_WITH(value=value, known=", ".join(known)))
        return value

    # --- as it is shown ----------------------------------------------------------------------------------------

    @property
    def heads(self) -> list[Head]:
        """Of all columns that are shown."""
        return [self._head(column) for column in self.columns if not column.hidden]

    def _head(self, column: Column) -> Head:
        up, down = column.name, f"-{column.name}"
        first, second = (down, up) if column.down or column.number else (up, down)
        state = {up: "ascending", down: "descending"}.get(self.sort, "") if column.by else ""
        return Head(column, {first: second, second: None}.get(self.sort, first), state)

    @property
    def chips(self) -> list[Chip]:
        """What it is narrowed to."""
        return [
            Chip(f"{one.label}: {dict(one.choices).get(value, value)}", self._without(one.name))
            for one in self.filters
            if (value := self.chosen[one.name])
        ]

    def _without(self, name: str) -> str:
        left = self._given.copy()
        for key in (name, "page"):
            left.pop(key, None)
        return left.urlencode()

    @property
    def fields(self) -> list[tuple[Filter, str]]:
        """Each filter with what is chosen."""
        return [(one, self.chosen[one.name]) for one in self.filters]

    # --- its rows ----------------------------------------------------------------------------------------------

    def ordered(self, rows: QuerySet[Any]) -> QuerySet[Any]:
        """As it is sorted; as they came where it is not. What is not known comes last."""
        if not self.sort:
            return rows
        down = self.sort.startswith("-")
        fields = [F(field) for field in self._by]
        return rows.order_by(
            *(one.desc(nulls_last=True) if down else one.asc(nulls_last=True) for one in fields),
            "-pk" if down else "pk",
        )

    def page(self, rows: QuerySet[Any], size: int) -> Page[Any]:
        """One page of them: all are sorted by their keys alone, and only what is shown is read whole."""
        keys = self.ordered(rows).values_list("pk", flat=True)
        page: Page[Any] = Paginator(keys, size).get_page(self.number)
        page.object_list = _in_order(rows, list(page.object_list))
        return page

    def sorted(self, rows: Sequence[Any]) -> list[Any]:
        """Rows by the attributes of their column, what is None last."""
        if not self.sort:
            return list(rows)
        value = attrgetter(*self._by)
        known = [row for row in rows if value(row) is not None]
        known.sort(key=value, reverse=self.sort.startswith("-"))
        return known + [row for row in rows if value(row) is None]

    @property
    def _by(self) -> tuple[str, ...]:
        name = self.sort.removeprefix("-")
        return next(column.by for column in self.columns if column.name == name)

    @property
    def has_file(self) -> bool:
        """True if its page can write it as a file."""
        return any(column.cell for column in self.columns)

    def file(
        self, request: HttpRequest, name: str, rows: QuerySet[Any] | Iterable[Any]
    ) -> StreamingHttpResponse:
        """All of them as `name`.csv; those of a query in the order of the list, others as they come.

        EvaError where the page says `fault`: nothing in a file would say that it is not narrowed.
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
    found: Mapping[Any, Any] = rows.order_by().in_bulk(keys)
    return [found[key] for key in keys if key in found]  # some may be gone meanwhile
