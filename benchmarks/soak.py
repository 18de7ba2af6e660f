"""Every fuzzer of benchmarks/fuzzing in turn, scenario after scenario: what was violated, what leaked, what grew."""

from __future__ import annotations

import gc
import importlib
import os
import pkgutil
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

import psutil

from benchmarks import fuzzing
from benchmarks.report import Figure, Report

SECONDS = 120.0
_SETTLED = 0.25  # of the time, after which nothing should grow any more
_GROWTH_MB = 30.0

Fuzzer = Callable[[int], list[str]]


class Held(NamedTuple):
    """What this process holds."""

    files: int
    threads: int
    children: int
    memory_mb: float


def fuzzers() -> Mapping[str, Fuzzer]:
    """`once` of each module in benchmarks/fuzzing, by its name."""
    names = sorted(module.name for module in pkgutil.iter_modules(fuzzing.__path__))
    modules = {name: importlib.import_module(f"benchmarks.fuzzing.{name}") for name in names}
    return {name: module.once for name, module in modules.items() if hasattr(module, "once")}


def measure(seconds: float, chosen: Mapping[str, Fuzzer] | None = None, first: int | None = None) -> Report:
    """Scenarios for `seconds`, from the seed `first` on, or from one drawn anew; the report names every violation."""
    chosen = chosen or fuzzers()
    first = secrets.randbelow(2**31) if first is None else first
    begun, settled = time.monotonic(), None
    counts, found = dict.fromkeys(chosen, 0), dict.fromkeys(chosen, 0)
    rows: list[dict[str, object]] = [{"first_seed": first}]
    seed = first
    while settled is None or time.monotonic() - begun < seconds:
        for name, once in chosen.items():
            violations = once(seed)
            counts[name] += 1
            found[name] += bool(violations)
            rows += [{"fuzzer": name, "seed": seed, "violation": said} for said in violations]
        seed += 1
        if settled is None and time.monotonic() - begun >= _SETTLED * seconds:
            settled = held()
    after = held()
    figures = [Figure(f"violations.{name}", found[name], "", "== 0") for name in chosen]
    figures += [Figure(f"scenarios.{name}", counts[name], "") for name in chosen]
    return Report("soak", [*figures, *_grown(settled, after)], rows)


def held() -> Held:
    """What this process holds now."""
    gc.collect()
    process = psutil.Process(os.getpid())
    memory = process.memory_info().rss / 1e6
    return Held(process.num_fds(), threading.active_count(), len(process.children()), memory)


def _grown(before: Held, after: Held) -> list[Figure]:
    return [
        Figure("leaks.files", after.files - before.files, "", "<= 0"),
        Figure("leaks.threads", after.threads - before.threads, "", "<= 0"),
        Figure("leaks.processes", after.children - before.children, "", "<= 0"),
        Figure("growth.memory", after.memory_mb - before.memory_mb, "MB", f"<= {_GROWTH_MB:g}"),
    ]
