"""A failure is doubted once, and only where it can be an accident."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from tests.whole import whole


class Suite:
    """Answers each run with the next code, and remembers what was run and told."""

    def __init__(self, *codes: int) -> None:
        self.codes = list(codes)
        self.ran: list[Sequence[str]] = []
        self.told: list[str] = []

    def __call__(self, arguments: Sequence[str]) -> int:
        self.ran.append(arguments)
        return self.codes.pop(0)


def test_what_passes_is_run_once() -> None:
    suite = Suite(0, 0)
    assert whole(suite, list, suite.told.append) == 0
    assert len(suite.ran) == 2
    assert suite.told == []


@pytest.mark.parametrize("codes", [(1, 0), (0, 1), (1, 1)])
def test_files_that_failed_are_run_again_and_named_as_unsteady(codes: tuple[int, int]) -> None:
    suite = Suite(*codes, 0)
    failed = ["tests/b.py::test_two[x::y]", "tests/a.py::test_one", "tests/b.py::test_three"]
    assert whole(suite, lambda: failed, suite.told.append) == 0
    assert suite.ran[2] == ["tests/a.py", "tests/b.py"]
    assert all(test in suite.told[-1] for test in failed)
    assert "unsteady" in suite.told[-1]


def test_what_fails_twice_failed() -> None:
    suite = Suite(0, 1, 1)
    assert whole(suite, lambda: ["tests/a.py::test_one"], suite.told.append) == 1
    assert not any("unsteady" in told for told in suite.told)


def test_many_failures_are_not_run_again() -> None:
    suite = Suite(1, 0)
    assert whole(suite, lambda: [f"tests/{n}.py::test" for n in range(7)], suite.told.append) == 1
    assert len(suite.ran) == 2


def test_a_failure_without_a_name_stays_one() -> None:
    suite = Suite(1, 0)
    assert whole(suite, list, suite.told.append) == 1
    assert len(suite.ran) == 2


@pytest.mark.parametrize("code", [2, 3, 4, 5, 139])
def test_a_suite_that_did_not_run_is_not_doubted(code: int) -> None:
    suite = Suite(1, code)
    assert whole(suite, lambda: ["tests/a.py::test_one"], suite.told.append) == code
    assert len(suite.ran) == 2
