"""The benchmark of coverage: its names, and that it sees an interval that does not cover."""

from __future__ import annotations

import pytest

from benchmarks import coverage
from benchmarks.coverage import Case


def test_a_figure_per_case_and_size_says_whether_the_interval_covers(monkeypatch: pytest.MonkeyPatch) -> None:
    cases = {"always": Case(lambda *_: True), "never": Case(lambda *_: False, fewest=3)}
    monkeypatch.setattr(coverage, "CASES", cases)
    report = coverage.measure(0.0)
    held = {figure.name: (figure.value, figure.holds) for figure in report.figures}
    assert held["coverage.always.1"] == (1.0, True)
    assert held["coverage.never.3"] == (0.0, False)
    assert "coverage.never.2" not in held
