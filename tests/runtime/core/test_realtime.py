"""What control gets of the kernel, and what its user is told where that is not the real-time class."""

from __future__ import annotations

import os
import resource
import subprocess
import sys

import pytest

from runtime.core import realtime

_ASK = (
    "from runtime.core import realtime; import gc, os; "
    "print(realtime.enter_realtime(20), os.sched_getscheduler(0), gc.isenabled())"
)


_ASK_BELOW = (
    "from runtime.core import realtime; import gc, os, threading; "
    "words = realtime.enter_realtime_below(20); found = []; "
    "child = threading.Thread(target=lambda: found.append(os.sched_getscheduler(0))); child.start(); child.join(); "
    "leaver = threading.Thread(target=lambda: (realtime.leave_realtime(), found.append(os.sched_getscheduler(0)))); "
    "leaver.start(); leaver.join(); "
    "got = os.sched_getscheduler(0); realtime.leave_realtime_all(); "
    "print(words, got, *found, gc.isenabled(), os.sched_getscheduler(0), sep='|')"
)


def asked(*before: str) -> tuple[str, int, bool]:
    """What a process of its own gets: the words, the class by the kernel, whether gc runs."""
    done = subprocess.run([*before, sys.executable, "-c", _ASK], capture_output=True, text=True, check=True)
    words, policy, collects = done.stdout.rsplit(maxsplit=2)
    return words, int(policy), collects == "True"


def test_who_comes_next_has_a_class_below_for_its_threads_too_but_for_those_that_leave_it() -> None:
    done = subprocess.run([sys.executable, "-c", _ASK_BELOW], capture_output=True, text=True, check=True)
    words, own, child, left, collects, at_last = done.stdout.strip().split("|")
    assert int(own) == (os.SCHED_FIFO if words.startswith("FIFO 19") else os.SCHED_OTHER)
    assert (child, int(left), collects) == (own, os.SCHED_OTHER, "True")
    assert int(at_last) == os.SCHED_OTHER


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


def test_who_comes_next_is_below_also_where_a_limit_holds_both(
    monkeypatch: pytest.MonkeyPatch, tried: list[int]
) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (10, 10))
    assert realtime._fifo(20, below=1) == "FIFO 9"
    assert tried == [19, 9]


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


_LOCKED = (
    "from runtime.core import realtime; import mmap; "
    "large, small = mmap.mmap(-1, 64 << 20, mmap.MAP_PRIVATE), mmap.mmap(-1, 1 << 20, mmap.MAP_PRIVATE); "
    "words = realtime.enter_realtime(20); "
    "held = int([row for row in open('/proc/self/status') if row.startswith('VmLck')][0].split()[1]); "
    "used = int([row for row in open('/proc/self/status') if row.startswith('VmRSS')][0].split()[1]); "
    "print(words, held >> 10, used >> 10, sep='|')"
)


def test_large_memory_that_is_not_used_is_locked_and_takes_no_room() -> None:
    done = subprocess.run([sys.executable, "-c", _LOCKED], capture_output=True, text=True, check=True)
    words, held, used = done.stdout.strip().split("|")
    if words.endswith("unlocked"):
        pytest.skip("this account may lock no memory")
    assert int(held) >= 64
    assert int(used) < 64
