"""Policies that move near the walls of a workspace box: no command may put the end effector outside it."""

from __future__ import annotations

from functools import cache

import numpy as np

import robots
from benchmarks.fuzzing.bodies import body
from runtime.core.types import Float64
from runtime.safety.filter import WorkspaceBox
from runtime.safety.workspace import Workspace
from tests.runtime.tick_bench import Bench

_TICKS = 150
_HALF = 0.12  # [m] half the size of each box


@cache
def _walled(name: str) -> tuple[Workspace, Float64]:
    robot = robots.load_robot(name)
    start = robot.poses["ready"].astype(np.float64)
    boxes = {}
    for arm in robot.arms:
        position = arm.pose(start)[:3]
        boxes[arm.name] = WorkspaceBox(lower=(position - _HALF).tolist(), upper=(position + _HALF).tolist())
    return Workspace(robot, boxes), start


def once(seed: int) -> list[str]:
    """Return the violations in the scenario of `seed`, as sentences."""
    rng = np.random.default_rng(seed)
    name = str(rng.choice(sorted(robots.robot_names())))
    workspace, start = _walled(name)
    _, limits, dims, _, _ = body(name)
    strategy = str(rng.choice(["async", "naive", "ensemble"]))
    bench = Bench({"kind": strategy}, limits, dims, workspace=workspace, jump=5.0, following_error=5.0)
    bench.measured = start
    bench.say("follow", run=1)
    for tick in range(_TICKS):
        if tick % 8 == 0:
            commanded = np.array(bench.status["commanded"], np.float64) if tick else start
            goal = np.where(
                limits.position_mask, commanded + rng.uniform(-1.0, 1.0, len(commanded)), commanded
            )
            bench.chunk(tick + 1, np.linspace(commanded, goal, int(rng.integers(8, 25))))
        if bench.behaviour == "hold":
            bench.say("follow", run=1)
        if rng.random() < 0.03:
            bench.say("hold", run=1)
        bench.run(stretch=rng.uniform(0.6, 1.4))
    excess = _excess(workspace, bench.sent)
    return [f"seed {seed}: {name} {excess * 1e3:.2f} mm outside its box"] if excess > 0.0 else []


def _excess(workspace: Workspace, commands: Float64) -> float:
    return float(workspace.excess(commands).max(initial=0.0))
