"""Quality of strategies with known policy actions: offset, error, jerk, reaction, starvation.

The parts of the strategies (query, merge, timeline, conditioning) run in integer steps in benchmarks/step_loop.py,
without processes, wire, safety or robot lag. This is deterministic, and fast enough for every cell.
`checked_in_lockstep` is the number of actions that the complete station in lockstep (benchmarks/strategy_station.py)
planned for the same policy. `different_in_lockstep` is how many of these actions the step loop does not reproduce bit
by bit.

A cell is one combination of parameters. It is infeasible if a chunk ends before the next one can arrive, which is the
case if H < delay + query interval. The query interval is the longer of 1 / rate and delay + 1 ticks, because a chunk is
requested on the tick after the last one arrived. The figures of an infeasible cell are in the rows, but in no summary
except `unrecovered_starvations`. The strategy `sync` waits for each chunk, so its cells are always feasible.

* `offset_steps`: delay of the published actions in steps. It is measured from the actions alone, not from what merging
  reports: it is the fractional shift of the reference that fits the actions best (least squares). For `sync` the
  reference of a chunk begins at the request of this chunk, and counts from the step on which the chunk's first row is
  executed.
* `rms_error` [rad]: difference of the published action and the reference at the same moment, also for `sync`.
* `jerk_ratio`: 95th percentile of the third difference of the published actions, relative to that of the reference.
* `..._disagreeing`: the same figure for chunks that each have a constant offset of up to 0.02 rad, which makes seams
  visible.
* `reaction50/90/99`: steps from a change of intention by 1 rad until 50, 90 or 99 % of the change is published. It is
  the worst of four changes. The first change comes right after a request was sent; the others are distributed over the
  interval.
* `starved`: steps without a plan. `spike`: the same figure if one answer takes longer than the chunk lasts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any

import numpy as np

from benchmarks import moving_target
from benchmarks.reference import DIM, IntendedRows, Reference, chunks_of, make_policy, with_disagreement
from benchmarks.report import Figure, Report
from benchmarks.step_loop import Executed, Log, StepLoop
from benchmarks.strategy_station import Case, compare
from runtime.core.plugins import variants
from runtime.core.types import Float64
from runtime.strategies.base import JOIN_WINDOW, StrategyParameters

KINDS = ("sync", "async", "ensemble", "naive", "rtc")
DELAYS = (0, 1, 3, 8, 15)  # [ticks]
RATES = (1.0, 3.0, 10.0, None)  # [Hz], None: back to back
HORIZONS = (16, 50)
CONTROLS = (30.0, 50.0, 100.0)  # [Hz]
_SECONDS = 6.0  # of virtual time per run
_CHANGES = 4
_SLOW = 4  # number of the delayed request in the run with a spike


@dataclass(frozen=True, slots=True)
class Cell(Case):
    """Parameters of a measurement, with quantities derived from them."""

    @property
    def interval(self) -> int:
        """Ticks from one request to the next, while the robot moves."""
        paced = 0 if self.inference_hz is None else math.ceil(self.control_hz / self.inference_hz - 1e-6)
        return max(self.delay + 1, paced)

    @property
    def feasible(self) -> bool:
        """Whether a chunk lasts until the next one can arrive."""
        return self.strategy == "sync" or self.horizon >= self.delay + self.interval

    @property
    def cycle(self) -> int:
        """Number of ticks of a whole cycle, in which each recurring event occurs at least once.

        It is the sum of horizon, delay, interval between requests, and the steps of a fade (JOIN_WINDOW).
        """
        return self.horizon + self.delay + self.interval + JOIN_WINDOW

    @property
    def config(self) -> StrategyParameters:
        """Parameters of the strategy: the defaults, at the cell's rate."""
        parameters: StrategyParameters = variants("runtime.strategies")[self.strategy].Config(
            inference_rate=self.inference_hz
        )
        return parameters

    def loop(self, meant: IntendedRows, start: Float64, spike: int = 0) -> StepLoop:
        """Return a step loop with the parameters of this cell, which starts at the joints `start`.

        `meant` returns the rows that the policy intends for a step. If `spike` is above 0, the answer to request number
        _SLOW takes `spike` ticks instead of the cell's delay.
        """
        module = variants("runtime.strategies")[self.strategy]

        def delay(number: int) -> int:
            return spike if spike and number == _SLOW else self.delay

        return StepLoop(module, self.config, make_policy(meant), delay, self.control_hz, start)


CHECKED = [
    Case(*values)
    for values in product(KINDS, (30.0,), (3.0, None), (50,), (0, 3, 15))
    if Cell(*values).feasible
]
THE_CELL = {"control_hz": 30.0, "inference_hz": 3.0, "horizon": 50, "delay": 3}


@dataclass(frozen=True, slots=True)
class Tracked:
    """Quality with which a strategy follows the reference; errors in rad, offset in steps."""

    offset: float
    rms_error: float
    jerk_ratio: float
    starved: int
    unrecovered: int


def measure(seconds: float) -> Report:
    """Measure all figures.

    `seconds` is the time for the measurement of the moving target alone; the cells have no time limit.
    """
    cells = [Cell(*values) for values in product(KINDS, CONTROLS, RATES, HORIZONS, DELAYS)]
    with ProcessPoolExecutor(2) as pool:
        rows = list(pool.map(_row, cells, chunksize=20))
        checked = list(pool.map(compare, CHECKED))
    moving = moving_target.table(seconds)
    figures = [
        *(figure for kind in KINDS for figure in _figures([row for row in rows if row["strategy"] == kind])),
        Figure("unrecovered_starvations", sum(row["unrecovered"] for row in rows), "", "== 0"),
        Figure("infeasible_cells", sum(not row["feasible"] for row in rows), ""),
        Figure("checked_in_lockstep", sum(actions for actions, _ in checked), "steps"),
        Figure("different_in_lockstep", sum(different for _, different in checked), "steps", "== 0"),
        *(Figure(f"on_target.{row['strategy']}.{row['delay']}", row["on_target"], "") for row in moving),
    ]
    tables = ({"table": "cells"}, rows), ({"table": "moving_target"}, moving)
    return Report("strategies", figures, [name | row for name, part in tables for row in part])


def _figures(rows: Sequence[dict[str, Any]]) -> Iterable[Figure]:
    """Yield the figures of one strategy: the worst values over its feasible cells, and the reaction in one cell."""
    kind, feasible = rows[0]["strategy"], [row for row in rows if row["feasible"]]
    reference_row = next(row for row in rows if all(row[key] == value for key, value in THE_CELL.items()))
    window = StrategyParameters().blend_window
    assert window != "all"
    bound = THE_CELL["delay"] + window + reference_row["interval"]
    yield Figure(f"offset_steps.{kind}", max(abs(row["offset_steps"]) for row in feasible), "steps", "== 0")
    for share in (50, 90, 99):
        allowed = f"<= {bound}" if (kind, share) == ("async", 99) else ""
        yield Figure(
            f"reaction{share}_steps.{kind}", reference_row[f"reaction{share}_steps"], "steps", allowed
        )
    for name in ("rms_error", "jerk_ratio"):
        unit = "rad" if name == "rms_error" else ""
        yield Figure(f"{name}.{kind}", max(row[name] for row in feasible), unit)
        yield Figure(f"{name}_disagreeing.{kind}", reference_row[f"{name}_disagreeing"], unit)
    yield Figure(f"starved_steps.{kind}", sum(row["starved_steps"] for row in feasible), "steps", "== 0")
    yield Figure(f"spike_starved_steps.{kind}", reference_row["spike_starved_steps"], "steps")


def _row(cell: Cell) -> dict[str, Any]:
    """Return the row of a cell."""
    exact, disagreeing = measure_tracking(cell, False), measure_tracking(cell, True)
    spike = measure_tracking(cell, False, spike=cell.horizon + 5)
    reaction = measure_reaction(cell) if cell.feasible else (None, None, None)
    return asdict(cell) | {
        "interval": cell.interval,
        "feasible": cell.feasible,
        "offset_steps": exact.offset,
        "rms_error": exact.rms_error,
        "jerk_ratio": exact.jerk_ratio,
        "rms_error_disagreeing": disagreeing.rms_error,
        "jerk_ratio_disagreeing": disagreeing.jerk_ratio,
        "reaction50_steps": reaction[0],
        "reaction90_steps": reaction[1],
        "reaction99_steps": reaction[2],
        "starved_steps": exact.starved,
        "spike_starved_steps": spike.starved,
        "unrecovered": exact.unrecovered + spike.unrecovered,
        "recovered": exact.unrecovered + spike.unrecovered == 0,
    }


def measure_tracking(cell: Cell, disagree: bool, spike: int = 0) -> Tracked:
    """Return how well the reference is followed for _SECONDS after the initial phase."""
    reference = Reference(cell.control_hz)
    begin = 2 * cell.cycle
    ticks = begin + 4 * spike + int(_SECONDS * cell.control_hz)
    table = reference.at(np.arange(ticks + 5 * cell.cycle + spike, dtype=float))
    chunk_of = chunks_of(table, cell.horizon)
    loop = cell.loop(with_disagreement(chunk_of) if disagree else chunk_of, table[0], spike)
    log = loop.run(ticks)
    for _ in range(4 * cell.cycle):  # so that a gap at the end can end
        if not log.executed[-1].starved:
            break
        loop.tick()
    steps, actions = np.arange(begin, ticks), _actions(log.executed[begin:ticks])
    return Tracked(
        offset=_offset(reference, cell, log, begin),
        rms_error=float(np.sqrt(np.mean((actions - table[steps]) ** 2))),
        jerk_ratio=_jerk(actions) / _jerk(table[steps]),
        starved=sum(tick.starved for tick in log.executed),
        unrecovered=int(log.executed[-1].starved),
    )


def _actions(ticks: Sequence[Executed]) -> Float64:
    return np.array([tick.action for tick in ticks]).reshape(-1, DIM)


def _jerk(actions: Float64) -> float:
    return float(np.percentile(np.linalg.norm(np.diff(actions, n=3, axis=0), axis=1), 95))


def _offset(reference: Reference, cell: Cell, log: Log, begin: int) -> float:
    """Return the delay of the published actions relative to the reference [steps], rounded to 6 decimals."""
    ticks = [tick for tick in log.executed[begin:] if tick.makers]
    if not ticks:
        return 0.0
    steps = np.array([tick.step for tick in ticks], np.float64)
    if cell.strategy == "sync":
        waited = {merged.chunk_id: merged.delay for merged in log.merged}
        steps -= [waited[tick.makers[0][0]] for tick in ticks]
    actions, late = _actions(ticks), 0.0
    for _ in range(5):
        error, slope = actions - reference.at(steps - late), reference.slope(steps - late)
        late -= float((error * slope).sum() / (slope * slope).sum())
    return round(late, 6) + 0.0


class _Mind:
    """Intention of the policy: the same value, 0 or 1, for all coming steps.

    The value does not depend on earlier values, and can be changed at any time.
    """

    def __init__(self, horizon: int) -> None:
        self.value = 0.0
        self._horizon = horizon

    def __call__(self, step: int) -> Float64:
        return np.full((self._horizon, DIM), self.value)


def measure_reaction(cell: Cell) -> tuple[int, int, int]:
    """Return the steps until 50, 90 and 99 % of a change of intention are published.

    Each is the worst of _CHANGES changes.
    """
    mind = _Mind(cell.horizon)
    loop = cell.loop(mind, np.zeros(DIM))
    period = cell.interval if cell.strategy != "sync" else cell.horizon + cell.delay
    settled = 2 * cell.cycle + cell.horizon
    worst = np.zeros(3, np.int64)
    for change in range(_CHANGES):
        loop.run(settled)
        requests = len(loop.log.observed)
        while len(loop.log.observed) == requests:
            loop.tick()
        loop.run(change * period // _CHANGES)
        at, before, mind.value = loop.step, mind.value, 1.0 - mind.value
        published = _actions(loop.run(settled).executed[at:])[:, 0]
        response = np.abs(published - before)
        worst = np.maximum(worst, [_last_below(response, share) + 1 for share in (0.5, 0.9, 0.99)])
    return int(worst[0]), int(worst[1]), int(worst[2])


def _last_below(response: Float64, share: float) -> int:
    """Return the index of the last step at which `response` is below `share`, with a tolerance of 1e-9; -1 if there is
    none.
    """
    below = np.flatnonzero(response < share - 1e-9)
    return int(below[-1]) if len(below) else -1
