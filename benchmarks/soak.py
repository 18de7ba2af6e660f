"""All fuzzers of benchmarks/fuzzing in turn, scenario after scenario: violations, leaks, memory growth."""

from __future__ import annotations

import ctypes
import gc
import importlib
import logging
import os
import pkgutil
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import psutil
from scipy.stats import theilslopes

from benchmarks import fuzzing
from benchmarks.report import Figure, Report

SECONDS = 120.0
_SETTLED = 0.25  # share of the time after which nothing should grow
_GROWTH_MB = 0.05  # per round: less than any complete scenario
_ROUNDS = 200  # rounds from which growth exceeds noise, with everything loaded before

Fuzzer = Callable[[int], list[str]]


class HeldResources(NamedTuple):
    """Resources that this process uses: files, threads, child processes, and memory."""

    files: int
    threads: int
    children: int
    memory_mb: float


def fuzzers() -> Mapping[str, Fuzzer]:
    """Return the function `once` of each module in benchmarks/fuzzing, by name."""
    names = sorted(module.name for module in pkgutil.iter_modules(fuzzing.__path__))
    modules = {name: importlib.import_module(f"benchmarks.fuzzing.{name}") for name in names}
    return {name: module.once for name, module in modules.items() if hasattr(module, "once")}


def measure(seconds: float, chosen: Mapping[str, Fuzzer] | None = None, first: int | None = None) -> Report:
    """Run scenarios for `seconds`, from the seed `first` on or from a random one; the report lists every violation."""
    chosen = chosen or fuzzers()
    first = secrets.randbelow(2**31) if first is None else first
    begun, seed = time.monotonic(), first
    counts = dict.fromkeys(chosen, 0)
    rows: list[dict[str, object]] = [{"first_seed": first}]
    settled: list[HeldResources] = []  # after each round after settling
    while not settled or time.monotonic() - begun < seconds:
        for name, once in chosen.items():
            with _quiet():
                violations = once(seed)
            counts[name] += bool(violations)
            rows += [{"fuzzer": name, "seed": seed, "violation": text} for text in violations]
        seed += 1
        if settled or time.monotonic() - begun >= _SETTLED * seconds:
            settled.append(held_resources())
    figures = [Figure(f"violations.{name}", counts[name], "", "== 0") for name in chosen]
    figures += [Figure(f"scenarios.{name}", seed - first, "") for name in chosen]
    return Report("soak", [*figures, *_grown(settled)], rows)


@contextmanager
def _quiet() -> Iterator[None]:
    """Log only errors within the context, because the scenarios provoke warnings."""
    log = logging.getLogger("runtime")
    before = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(before)


def held_resources() -> HeldResources:
    """Return the resources that this process uses, without memory that the C library has not returned yet."""
    gc.collect()
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):  # not available in musl
        trim(0)
    process = psutil.Process(os.getpid())
    memory = process.memory_info().rss / 1e6
    return HeldResources(process.num_fds(), threading.active_count(), len(process.children()), memory)


def _grown(settled: Sequence[HeldResources]) -> list[Figure]:
    """Return figures on growth: of the counts from first to last round, and of memory per round.

    Memory has no requirement if there are too few rounds.
    """
    before, after = settled[0], settled[-1]
    memory = [sample.memory_mb for sample in settled]
    slope = float(theilslopes(memory).slope) if len(memory) > 1 else 0.0
    allowed = f"<= {_GROWTH_MB:g}" if len(memory) >= _ROUNDS else ""
    return [
        Figure("leaks.files", after.files - before.files, "", "<= 0"),
        Figure("leaks.threads", after.threads - before.threads, "", "<= 0"),
        Figure("leaks.processes", after.children - before.children, "", "<= 0"),
        Figure("growth.memory", slope, "MB", allowed),
        Figure("growth.rounds", len(memory), ""),
    ]
