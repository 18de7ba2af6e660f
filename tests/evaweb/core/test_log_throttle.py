"""What the log says of a crowd."""

from __future__ import annotations

import pytest

from evaweb.core.log_throttle import LogThrottle


@pytest.fixture
def now():
    return [100.0]


@pytest.fixture
def rarely(now):
    return LogThrottle(10.0, most=3, clock=lambda: now[0])


def test_each_name_is_due_once_in_its_time_with_how_often_it_came_since(rarely, now):
    assert [
        rarely.suffix_if_due("a"),
        rarely.suffix_if_due("a"),
        rarely.suffix_if_due("a", 5),
        rarely.suffix_if_due("b"),
    ] == ["", None, None, ""]
    now[0] += 10.0
    assert rarely.suffix_if_due("a") == " (6 before it)"
    now[0] += 10.0
    assert rarely.suffix_if_due("a", 3) == " (2 before it)", "of three that came at once"


def test_so_many_names_are_due_and_all_others_are_one(rarely, now):
    said = [rarely.suffix_if_due(str(number)) for number in range(1000)]
    assert [line for line in said if line is not None] == [""] * 4
    now[0] += 9.9
    assert rarely.suffix_if_due("late") is None
    assert len(rarely._told) == 4
    now[0] += 0.1
    said = [rarely.suffix_if_due(f"again {number}") for number in range(1000)]
    assert [line for line in said if line is not None].count("") <= 4
    assert len(rarely._told) <= 4


def test_others_are_told_again_with_how_many_they_were(rarely, now):
    for at in (100.0, 105.0):
        now[0] = at
        for name in "abcdefg":
            rarely.suffix_if_due(name)
    for name in "abc":
        now[0] = 110.0
        rarely.suffix_if_due(name)
    assert rarely.suffix_if_due("h") == " (7 of other names before it)"
