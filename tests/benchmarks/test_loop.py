"""How the loop benchmark judges a recording, and what is wanted in which class."""

from __future__ import annotations

import os
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from benchmarks.loop import _figures, _judged

RATE = 100.0
BARE = {"scheduling": "FIFO 20", "late": [0.0002] * 100}
COMMON = {"steps": list(range(100)), "woke": [n * 0.0101 for n in range(100)]}


def episode(steps: list[int], late: list[float], worked: float = 0.0003) -> Any:
    planned = np.array(steps) / RATE
    woke = planned + np.array(late)
    table = pa.table({"step": steps, "planned": planned, "woke": woke, "sent": woke + worked})
    outcome = {"repeated": {"front": 2, "wrist": 5}, "muxed_ms": {}}
    return SimpleNamespace(ticks=table, outcome=outcome, frames=len(steps))


def judged(
    steps: list[int], late: list[float], scheduling: str = "FIFO 20", others: float = 3.0
) -> dict[str, Any]:
    control = {"scheduling": scheduling}
    row = _judged(episode(steps, late), RATE, control, (BARE, COMMON))
    used = {"lab": 40.0 * (os.cpu_count() or 1), "measuring": 5.0, "others": others}
    return {**row, "rate": RATE, "cpu_percent": used}


def test_lateness_is_of_every_tick_and_compared_with_the_bare_loop() -> None:
    row = judged(list(range(100)), [0.0001] * 100)
    assert row["lateness_ms"]["p99"] == pytest.approx(0.1)
    assert row["sent_ms"]["p50"] == pytest.approx(0.4)
    assert row["ratio"] == pytest.approx(0.5)
    assert (row["ticks"], row["missed"], row["repeated"]) == (100, 0, 5)


def test_a_tick_after_a_gap_is_as_late_as_the_gap_was_long() -> None:
    row = judged([*range(50), *range(53, 100)], [0.0] * 97)
    assert row["missed"] == 3
    assert row["lateness_ms"]["max"] == pytest.approx(30.0)


def test_the_error_of_the_rate_is_that_of_the_fit() -> None:
    row = judged(list(range(100)), [0.0] * 100)
    assert row["rate_error_ppm"] == pytest.approx(0.0, abs=1e-3)
    assert row["effective_rate_hz"] == pytest.approx(RATE)
    assert row["sleep_rate_error_ppm"] == pytest.approx(-9900.99, abs=0.1)


def test_the_class_decides_what_is_wanted() -> None:
    late = [0.0001] * 90 + [0.0015] * 10
    fifo = {f.name: f.holds for f in _figures(judged(list(range(100)), late))}
    assert fifo["lateness_p99_ms.100"] is False
    assert fifo["missed_ticks.100"] is True
    assert fifo["ratio_to_bare_loop.100"] is None
    other = {f.name: f.holds for f in _figures(judged(list(range(100)), late, "slice 0.1 ms"))}
    assert other["lateness_p99_ms.100"] is True
    assert other["ratio_to_bare_loop.100"] is False
    assert other["missed_ticks.100"] is None
    full = judged(list(range(100)), late, "slice 0.1 ms", others=60.0 * (os.cpu_count() or 1))
    saturated = {f.name: f.holds for f in _figures(full)}
    assert saturated["lateness_p99_ms.100"] is None
    assert saturated["ratio_to_bare_loop.100"] is False
