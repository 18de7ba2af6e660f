"""Declarations of statistics: each says how a statistic is computed, written as JSON, and shown on pages and in
reports.

The declarations are the fields of `Arm` and `Comparison`; output is in the order of these fields
(docs/contributing.md).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from typing import Any

from evaweb.statistics.base import StatisticsError

Answer = tuple[str, str, str]  # question, method, answer
_ROW = "statistic"


@dataclass(frozen=True, slots=True)
class Column:
    """Column of the table of checkpoints, on the page and in the report.

    The cells of the column are checked by the program that is part of the report.

    Attributes:
        head: Heading.
        cell: Function from a statistic's value and its arm to the text.
    """

    head: str
    cell: Callable[[Any, Any], str]
    page: bool = True
    report: bool = True

    def text(self, arm: Any, name: str) -> str:
        """Return the text of an arm's cell; "" without a value."""
        value = getattr(arm, name)
        return "" if value is None else self.cell(value, arm)


@dataclass(frozen=True, slots=True)
class Statistic:
    """Declaration of one statistic of an arm or a comparison.

    Attributes:
        compute: Function from the trials to the value. If the trials do not determine the value, the function
            returns None or raises StatisticsError.
        key: Name in JSON, also used by REST and reports; "" if another declaration writes the value.
        form: Function from the value to its JSON.
        write: Used instead of `key` and `form`: function from the whole arm or comparison to a part of its JSON
            object.
        answers: Function from the comparison, the value and the context (`AnswerContext`) to the answers that pages
            show.
        rank: Order of the answers; within one rank they are in the order of declarations.
        none_too: Whether `answers` is also called with the value None.
        describes: Whether the statistic is shown while the design of its comparison has not ended.
        column: Column of the table of checkpoints.
    """

    compute: Callable[[Any], Any]
    key: str = ""
    form: Callable[[Any], Any] = lambda value: value
    write: Callable[[Any], dict[str, Any]] | None = None
    answers: Callable[[Any, Any, Any], list[Answer]] = lambda *_: []
    rank: int = 0
    none_too: bool = False
    describes: bool = False
    column: Column | None = None


def statistic(*declared: Any, **more: Any) -> Any:
    """Return a dataclass field that declares a `Statistic` with these arguments."""
    return field(metadata={_ROW: Statistic(*declared, **more)})


def statistics_of(kind: Any) -> dict[str, Statistic]:
    """Return the declarations in `Arm` or `Comparison` by the name of their field."""
    return {field.name: field.metadata[_ROW] for field in fields(kind) if _ROW in field.metadata}


def compute_all(kind: Any, trials: Any, notes: list[str] | None = None) -> dict[str, Any]:
    """Return the values of all statistics of `kind` by name.

    With `notes`, a statistic that cannot be computed is None, and the reason is appended to `notes`.

    Raises:
        StatisticsError: If one cannot be computed and there are no `notes`.
    """
    values: dict[str, Any] = {}
    for name, row in statistics_of(kind).items():
        try:
            values[name] = row.compute(trials)
        except StatisticsError as error:
            if notes is None:
                raise
            values[name] = None
            notes.append(str(error))
    return values


def write_all(found: Any) -> dict[str, Any]:
    """Return the statistics of an arm or a comparison as JSON."""
    document: dict[str, Any] = {}
    for name, row in statistics_of(type(found)).items():
        value = getattr(found, name)
        if row.write:
            document |= row.write(found)
        elif row.key:
            document[row.key] = None if value is None else row.form(value)
    return document


def answer_all(found: Any, context: Any) -> Iterator[tuple[str, Answer]]:
    """Yield all answers of a comparison, each with the name of its statistic, in the order of the statistics' ranks."""
    for name, row in sorted(statistics_of(type(found)).items(), key=lambda item: item[1].rank):
        value = getattr(found, name)
        if value is not None or row.none_too:
            yield from ((name, answer) for answer in row.answers(found, value, context))
