"""How the policy did over a run."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.ipc.messages import MergeResult
from runtime.processes.coordinator.inference.metrics import PolicyMetrics, quantile


def merged(delay: int, mistimed: int = 0, dropped: str = "") -> MergeResult:
    return MergeResult(1, 10, delay, np.zeros(4, np.int64), mistimed, dropped, 1)


def test_answers_delays_and_what_went_wrong_are_counted() -> None:
    metrics = PolicyMetrics()
    for milliseconds in range(1, 101):
        metrics.add_response(milliseconds / 1000)
    metrics.add_merge(merged(3))
    metrics.add_merge(merged(5, mistimed=2))
    metrics.add_merge(merged(60, dropped="all in the past"))
    figures = metrics.figures()
    assert (figures["answers"], figures["mistimed"], figures["dropped"]) == (100, 1, 1)
    assert figures["latency_ms"]["p50"] == 50.5
    assert figures["latency_ms"]["max"] == 100.0
    assert figures["delay_steps"] == {"p50": 5.0, "p90": 49.0, "p99": 58.9, "max": 60.0}


def test_without_a_measurement_there_is_no_figure() -> None:
    metrics = PolicyMetrics()
    assert metrics.figures()["latency_ms"] is None
    assert metrics.figures()["delay_steps"] is None
    newest = metrics.recent()
    assert (newest["latencies_ms"], newest["delays"]) == ([], [])
    assert all(math.isnan(newest[name]) for name in ("latency_p50_ms", "delay_p50", "delay_max"))
    assert math.isnan(quantile([], 50))


def test_a_page_is_told_the_newest_sixty_and_the_counts_go_on() -> None:
    metrics = PolicyMetrics()
    for number in range(100):
        metrics.add_response(number / 1000)
        metrics.add_merge(merged(number))
    told = metrics.recent()
    assert told["delays"] == list(range(40, 100))
    assert len(told["latencies_ms"]) == 60
    assert metrics.answers == 100


def test_how_old_an_observation_was_when_the_policy_was_asked_is_a_figure() -> None:
    metrics = PolicyMetrics()
    metrics.add_response(0.1)
    assert metrics.figures()["observation_age_ms"] is None
    for age in (0.010, 0.020, 0.030):
        metrics.add_response(0.1, age)
    assert metrics.figures()["observation_age_ms"] == {
        "p50": 20.0,
        "p90": pytest.approx(28.0),
        "p99": pytest.approx(29.8),
        "max": 30.0,
    }


def test_a_page_is_told_the_spread_of_the_newest_three_hundred() -> None:
    metrics = PolicyMetrics()
    for number in range(1000):
        metrics.add_response(number / 1000)
        metrics.add_merge(merged(1000 - number))
    told = metrics.recent()
    assert told["latency_p50_ms"] == pytest.approx(849.5)
    assert told["latency_p90_ms"] == pytest.approx(969.1)
    assert (told["delay_p50"], told["delay_max"]) == (150.5, 300)
    assert metrics.figures()["latency_ms"]["p50"] == pytest.approx(499.5)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=50), st.floats(0, 100))
def test_a_quantile_is_that_of_numpy(values: list[float], percent: float) -> None:
    assert quantile(values, percent) == pytest.approx(float(np.percentile(values, percent)), abs=1e-6)


def test_a_new_run_begins_anew() -> None:
    metrics = PolicyMetrics()
    metrics.add_response(0.1, 0.02)
    metrics.add_merge(merged(3, mistimed=1, dropped="x"))
    metrics.count_starved()
    metrics.count_lost()
    assert (metrics.starved, metrics.lost) == (1, 1)
    metrics.reset()
    assert metrics.figures() == PolicyMetrics().figures()
