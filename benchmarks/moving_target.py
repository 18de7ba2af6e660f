"""A target that moves: the block rides on the simulated conveyor, and each strategy is to stay beside it.

Everything is the product's own, in lockstep and deterministic: the node with its gate, plant and messages
(runtime/sim), the whole station (media, the coordinator, control, safety), the strategies. Only time is virtual and the
sockets are left out. What was chosen, and why:

* The policy (runtime/sim/chase.py) sees a picture for each request, takes the block to go on as it does, and answers
  50 rows at 30 Hz. It knows what robots lag behind, and the ends of the belt; not when the belt will turn.
* The belt changes its speed every 2.6 s on average, at 60 to 100 mm/s: a slow one, far below what the arm can do,
  so that nothing but time decides. On target means: fingertips at most half of a block's edge, 20 mm, from
  their place beside it. Success: for two thirds of the 20 s of the course, a bar that was set when the shares were
  known, between those of `async` at 8 and at 15 ticks; sync is far below it wherever it fails. For any other bar the
  shares of every course are there.
* A strategy that moves asks back to back, but at most 10 times a second. `sync` executes 10 rows, a third of a
  second, of each chunk: with fewer it stands most of the time, with more it sees too late that the belt has turned.
  Everything else has its default.
* Pictures are drawn when the policy asks, and then of the very frame that it asks about: the station carries a
  stamp with the number of the frame in the place of each picture. An episode takes about a second like this.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.conveyor_station import station_at
from benchmarks.report import Figure, Report
from runtime.core.types import Float64
from runtime.ipc.session_state import SessionState
from runtime.processes.lockstep.lockstep import Lockstep
from runtime.sim.conveyor import COURSE_S, Conveyor

DELAYS = (0, 1, 3, 8, 15)  # control ticks of 1/30 s
STRATEGIES: Mapping[str, Mapping[str, Any]] = {
    "sync": {"execution_horizon": 10},
    "async": {"inference_rate": 10.0},
    "rtc": {"inference_rate": 10.0},
    "naive": {"inference_rate": 10.0},
    "ensemble": {"inference_rate": 10.0},
}
SEEDS = 3
_WANTED = {"success_rate.sync.8": "== 0", "success_rate.async.8": "== 1", "success_rate.rtc.8": "== 1"}
_PER_SEED_S = 20.0  # of wall time, about
_ARRIVING_S = 10.0  # until fingertips have to be beside the block that stands


@dataclass(frozen=True, slots=True)
class ChaseResult:
    """One episode: lengths in mm, `share` of the time of the course on target, `state` of the station at its end.

    `acceleration` [rad/s2] is that of the joint whose commands change most, exceeded in 5 % of the ticks.
    """

    strategy: str
    delay: int
    seed: int
    success: bool
    share: float
    mean: float
    p95: float
    acceleration: float
    state: str


def measure(seconds: float) -> Report:
    """`success_rate.STRATEGY.DELAY`, `on_target.STRATEGY.DELAY` (share of the time); the rest is in the rows."""
    rows = table(seconds)
    figures = [
        Figure(f"{name}.{cell}", row[name], "", _WANTED.get(f"{name}.{cell}", ""))
        for name in ("success_rate", "on_target")
        for row, cell in ((row, f"{row['strategy']}.{row['delay']}") for row in rows)
    ]
    return Report("moving_target", figures, rows)


def table(seconds_budget: float) -> list[dict[str, Any]]:
    """A row for each strategy and delay [ticks]; distances in mm, means over the episodes.

    Three courses for each, more where the budget allows it: the same for the same budget on every machine.
    """
    seeds = range(max(SEEDS, int(seconds_budget / _PER_SEED_S)))
    asked = list(product(STRATEGIES, DELAYS, seeds))
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        episodes = list(pool.map(_chased, asked))
    return [
        _row([one for one in episodes if (one.strategy, one.delay) == cell])
        for cell in product(STRATEGIES, DELAYS)
    ]


def _row(episodes: list[ChaseResult]) -> dict[str, Any]:
    first = episodes[0]
    figures = {"success_rate": "success", "on_target": "share", "mean_mm": "mean", "p95_mm": "p95"}
    figures["acceleration_p95"] = "acceleration"
    means = {
        name: float(np.mean([getattr(one, field) for one in episodes])) for name, field in figures.items()
    }
    shares = [round(one.share, 4) for one in episodes]
    held = sum(one.state != SessionState.RUNNING for one in episodes)
    row = {"strategy": first.strategy, "delay": first.delay, "episodes": len(episodes), **means}
    return row | {"shares": shares, "held": held}


def _chased(asked: tuple[str, int, int]) -> ChaseResult:
    strategy, delay, seed = asked
    return run_chase({"kind": strategy, **STRATEGIES[strategy]}, delay, seed)


def run_chase(strategy: Mapping[str, Any], delay: int, seed: int) -> ChaseResult:
    """One episode in lockstep, to the end of the course; one that never begins has no share of it."""
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        course, made = station_at(Path(folder), strategy, delay, seed)
        with closing(made) as station:
            commanded = _follow(station, course)
            state, rate = str(station.coordinator.session.state), station.spec.rate
    escort = course.escort
    return ChaseResult(
        strategy=str(strategy["kind"]),
        delay=delay,
        seed=seed,
        success=course.success,
        share=escort.on_target_share,
        mean=1e3 * escort.mean,
        p95=1e3 * escort.quantile(0.95),
        acceleration=_acceleration(commanded) * rate**2,
        state=state,
    )


def _follow(station: Lockstep, conveyor: Conveyor) -> Float64:
    """Set up, run until the course is over; returns the arms' commands [ticks, D] of the course."""
    session, commanded = station.coordinator.session, []
    station.connect()
    station.until(lambda: session.state is not SessionState.DISCONNECTED, 5.0, "first observation")
    station.command("setup")
    station.until(lambda: session.state is SessionState.READY, 60.0, "set-up")
    station.command("run")
    end = station.clock.now() + _ARRIVING_S + COURSE_S

    def over() -> bool:
        if conveyor.running:
            commanded.append(np.array(station.shared.control.read()["commanded"], np.float64))
        return conveyor.over or station.clock.now() > end

    station.until(over, 2 * (_ARRIVING_S + COURSE_S), "the course")
    return np.array(commanded).reshape(-1, station.spec.robot.dim)[:, ~station.spec.limits.grippers]


def _acceleration(commanded: Float64) -> float:
    """Of commands [ticks, n], per tick and tick; 0 where there are too few to have one."""
    changes = np.abs(np.diff(commanded, 2, axis=0))
    return float(np.quantile(changes.max(axis=1), 0.95)) if len(changes) else 0.0
