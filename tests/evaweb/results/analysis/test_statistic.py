"""A row says all of a statistic: how it is computed, written and shown."""

from dataclasses import dataclass

import pytest

from evaweb.results.analysis.arm import Arm
from evaweb.results.analysis.comparison import Comparison
from evaweb.results.analysis.statistic import (
    Column,
    answer_all,
    compute_all,
    statistic,
    statistics_of,
    write_all,
)
from evaweb.statistics.base import StatisticsError


def fail(trials):
    raise StatisticsError("too few")


@dataclass(frozen=True, slots=True)
class Both:
    name: str
    late: int = statistic(len, "late", answers=lambda c, n, _: [("Late?", "count", str(n))], rank=2)
    total: int = statistic(sum, "total", lambda n: [n], answers=lambda c, n, more: [("All?", more, c.name)])
    gone: int | None = statistic(fail, "gone", lambda n: n + 1, answers=lambda *_: [("Gone?", "", "")])
    bound: int | None = statistic(lambda trials: None, answers=lambda *_: [("Any?", "", "")], none_too=True)
    parts: int = statistic(min, write=lambda c: {"low": c.parts, "name": c.name})


def test_a_row_is_computed_written_and_answered_in_its_order():
    notes = []
    found = Both("x", **compute_all(Both, [3, 4], notes))
    assert notes == ["too few"]
    assert list(write_all(found).items()) == [
        ("late", 2),
        ("total", [7]),
        ("gone", None),
        ("low", 3),
        ("name", "x"),
    ]
    assert list(answer_all(found, "sum")) == [
        ("total", ("All?", "sum", "x")),
        ("bound", ("Any?", "", "")),
        ("late", ("Late?", "count", "2")),
    ]


def test_without_notes_what_cannot_be_computed_is_an_error():
    with pytest.raises(StatisticsError, match="too few"):
        compute_all(Both, [3])


def test_a_cell_without_a_value_is_empty():
    found = Both("x", 2, 7, None, None, 3)
    column = Column("Late", lambda n, arm: f"{n} of {arm.name}")
    assert (column.text(found, "late"), column.text(found, "gone")) == ("2 of x", "")


@pytest.mark.parametrize("kind", [Arm, Comparison])
def test_no_name_in_json_is_declared_twice(kind):
    keys = [row.key for row in statistics_of(kind).values() if row.key]
    assert len(set(keys)) == len(keys) > 5
