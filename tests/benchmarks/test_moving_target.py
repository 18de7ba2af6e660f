from __future__ import annotations

import numpy as np
import pytest

from benchmarks import moving_target
from benchmarks.moving_target import STRATEGIES, ChaseResult, run_chase


@pytest.fixture(autouse=True)
def short_course(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("runtime.simulation.bench.conveyor.COURSE_S", 6.0)


def chased(strategy: str, delay: int, seed: int = 1) -> ChaseResult:
    return run_chase({"kind": strategy, **STRATEGIES[strategy]}, delay, seed)


@pytest.mark.exhaustive
def test_async_stays_with_the_block_at_eight_ticks_of_delay_and_sync_does_not() -> None:
    moving, waiting = chased("async", 8), chased("sync", 8)
    assert moving.success
    assert not waiting.success
    assert moving.share > 2 * waiting.share
    assert moving.mean < waiting.mean
    assert moving.acceleration < waiting.acceleration


@pytest.mark.exhaustive
def test_without_delay_both_do_and_an_episode_is_the_same_to_the_last_bit() -> None:
    moving, waiting = chased("async", 0), chased("sync", 0)
    assert moving.success
    assert waiting.success
    assert chased("sync", 0) == waiting


def test_a_row_is_the_mean_of_its_episodes() -> None:
    one = ChaseResult("rtc", 3, 0, True, 0.9, 4.0, 20.0, 5.0, "running")
    two = ChaseResult("rtc", 3, 1, False, 0.5, 8.0, 40.0, 7.0, "holding")
    assert moving_target._row([one, two]) == {
        "strategy": "rtc",
        "delay": 3,
        "episodes": 2,
        "success_rate": 0.5,
        "on_target": 0.7,
        "mean_mm": 6.0,
        "p95_mm": 30.0,
        "acceleration_p95": 6.0,
        "shares": [0.9, 0.5],
        "held": 1,
    }


def test_commands_of_constant_speed_have_no_acceleration() -> None:
    assert moving_target._acceleration(np.arange(30.0).reshape(-1, 1)) == 0.0
    assert moving_target._acceleration(np.zeros((1, 3))) == 0.0
    assert moving_target._acceleration(np.arange(30.0).reshape(-1, 1) ** 2) == pytest.approx(2.0)
