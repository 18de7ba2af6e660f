"""Bench with contact forces against the bench without: success of the scripted policy, and cost of the physics.

For every known robot, the scripted pick-and-place policy does its task in joints on both benches, one trial per seed,
and with three robots on the bench with contact forces also in poses.
Node, bench, policy server and station are the product's own, in lockstep on a virtual clock.

* `success.BENCH.ROBOT`: number of trials that end with the block at rest on the plate, within 40 s.
* `success_in_poses.ROBOT`: the same number with actions in poses, with contact forces.
* `sorted.ROBOT`: number of trials in which all five blocks of the bench `sorting` are in their bins within 120 s.
* `tick_ms.BENCH.ROBOT`: median processor time of the robot and the bench for a tick of the control rate, without
  images. Ticks of trials are measured: the arm moves, and the block is held for about half of the time.
* `tick_ratio.ROBOT`: quotient of the sums over all ticks, with contact forces over without.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.report import Figure, Report
from robots import Robot
from runtime.benches.schema import load_schema
from runtime.simulation.bench.bench import Bench
from runtime.simulation.bench.block_table import BlockTable
from runtime.simulation.bench.plant import Plant
from runtime.simulation.bench.tabletop import Tabletop
from runtime.simulation.contact.bench import ContactTabletop
from runtime.simulation.scripts.pick_place import Skill
from tests.runtime.simulation.bench_trial import ROBOT, Trial
from tests.runtime.simulation.tabletop_station import pick_and_place

DEPLOYMENTS = {  # robot -> deployment with actions in joints
    "agilex_piper": "tabletop",
    "arx_r5": "tabletop_arx_r5",
    "dual_franka": "tabletop_dual_franka",
    "r1_lite": "tabletop_r1_lite",
    "ur5e": "tabletop_ur5e",
    "agibot_g2": "tabletop_agibot_g2",
}
IN_POSES = {  # robot -> deployment, and settings that make its actions poses
    "agilex_piper": ("tabletop_agilex_piper_eef", ()),
    "ur5e": ("tabletop_ur5e_eef", ()),
    "dual_franka": ("tabletop_dual_franka", ('policy.action_space="eef"',)),
}
SEEDS = 20
_SORTING = load_schema("sorting")


def measure(seconds: float) -> Report:
    """Return successes and processor times of all robots; `seconds` has no effect."""
    figures, rows = [], []
    for robot, deployment in DEPLOYMENTS.items():
        spent: dict[str, list[float]] = {"tabletop": [], "contact": []}
        for bench, times in spent.items():
            successes = [_try(deployment, seed, bench, times) for seed in range(SEEDS)]
            rows += [
                {"robot": robot, "bench": bench, "seed": seed, "success": success}
                for seed, success in enumerate(successes)
            ]
            wanted = f">= {0.9 * SEEDS:g}" if bench == "contact" else ""
            figures.append(Figure(f"success.{bench}.{robot}", sum(successes), "", wanted))
            figures.append(Figure(f"tick_ms.{bench}.{robot}", 1e3 * float(np.median(times)), "ms"))
        ratio = float(np.sum(spent["contact"]) / np.sum(spent["tabletop"]))
        figures.append(Figure(f"tick_ratio.{robot}", ratio, ""))
    for robot, (deployment, assignments) in IN_POSES.items():
        successes = [_try(deployment, seed, "contact", [], assignments) for seed in range(SEEDS)]
        figures.append(Figure(f"success_in_poses.{robot}", sum(successes), "", f">= {0.9 * SEEDS:g}"))
    trials = [
        Trial(Skill(), make=_sorting, prompt=_SORTING.instruction, bench="sorting") for _ in range(SEEDS)
    ]
    successes = [trial.lay(seed).run(120.0).success for seed, trial in enumerate(trials)]
    figures.append(Figure(f"sorted.{ROBOT.name}", sum(successes), "", f">= {0.9 * SEEDS:g}"))
    return Report("contact", figures, rows)


def _sorting(robot: Robot, seed: int) -> BlockTable:
    return ContactTabletop(robot, seed, bench=Bench(_SORTING))


def _try(deployment: str, seed: int, bench: str, times: list[float], assignments: Sequence[str] = ()) -> bool:
    """Return whether a trial succeeded; append the processor time of each tick [s] to `times`."""
    kind: Callable[[Robot, int], BlockTable] = ContactTabletop if bench == "contact" else Tabletop
    with tempfile.TemporaryDirectory() as data:
        timed = partial(_timed, kind, times)
        return pick_and_place(deployment, seed, Path(data), assignments, make=timed).success


def _timed(
    kind: Callable[[Robot, int], BlockTable], times: list[float], robot: Robot, seed: int
) -> BlockTable:
    """Return a bench of a kind that appends the processor time of each tick [s] to `times`."""
    table = kind(robot, seed)
    advance = table.advance

    def timed(plant: Plant, seconds: float) -> None:
        started = time.process_time()
        advance(plant, seconds)
        times.append(time.process_time() - started)

    setattr(table, "advance", timed)  # noqa: B010 - a method is replaced on purpose
    return table
