"""What control gets of the kernel, and what its user is told where that is not the real-time class."""

from __future__ import annotations

import os
import resource
import subprocess
import sys

import pytest

from runtime import realtime

_ASK = (
    "from runtime import realtime; import gc, os; "
    "print(realtime.enter(20), os.sched_getscheduler(0), gc.isenabled())"
)


def asked(*before: str) -> tuple[str, int, bool]:
    """What a process of its own gets: the words, the class by the kernel, whether gc runs."""
    done = subprocess.run([*before, sys.executable, "-c", _ASK], capture_output=True, text=True, check=True)
    words, policy, collects = done.stdout.rsplit(maxsplit=2)
    return words, int(policy), collects == "True"


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Priorities that were asked for, of a kernel that permits 10 and less."""
    asked_for: list[int] = []

    def ask(_: int, __: int, parameters: os.sched_param) -> None:
        asked_for.append(parameters.sched_priority)
        if not 1 <= parameters.sched_priority <= 10:
            raise PermissionError("not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", ask)
    return asked_for


def test_what_it_says_is_what_the_kernel_says_and_gc_is_off() -> None:
    words, policy, collects = asked()
    assert policy == (os.SCHED_FIFO if words.startswith("FIFO 20") else os.SCHED_OTHER)
    assert words.removesuffix(" unlocked") in ("FIFO 20", "slice 0.1 ms", "ordinary")
    assert len(words) <= 24  # it has to fit into control's status
    assert collects is False


def test_a_limit_below_the_wanted_priority_is_used(monkeypatch: pytest.MonkeyPatch, tried: list[int]) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (10, 10))
    assert realtime._fifo(20) == "FIFO 10"
    assert tried == [20, 10]


def test_without_a_limit_there_is_no_real_time_class(
    monkeypatch: pytest.MonkeyPatch, tried: list[int]
) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (0, 0))
    assert realtime._fifo(20) == ""
    assert tried == [20, 0]


def test_advice_is_for_who_lacks_the_class_and_names_both_ways_to_get_it() -> None:
    assert realtime.advice("FIFO 20 unlocked", 20) == ""
    assert realtime.advice(realtime.LOCKSTEP, 20) == ""
    told = realtime.advice("slice 0.1 ms", 30)
    assert "rtprio limit of 30" in told
    assert "LimitRTPRIO=30" in told
    assert "docs/administrator.md" in told
