"""A bench with a program of its own, which counts what it is told, for tests; its environment is that of the tests."""

from __future__ import annotations

import sys
from pathlib import Path

from runtime.benches.environments import environment_of

ROBOT = """
title = "A hand"
urdf = "hand.urdf"
limits_source = "none (overrides)"
control_rate = 20.0
cameras = { only = "cam_only" }

[[groups]]
name = "hand"
kind = "base"
joints = ["dx", "dy"]
urdf_joints = ["", ""]
overrides = [
  { joint = "dx", lower = -1.0, upper = 1.0, velocity = 1.0, reason = "a test's" },
  { joint = "dy", lower = -1.0, upper = 1.0, velocity = 1.0, reason = "a test's" },
]

[poses.home]
hand = [0.0, 0.0]
"""
BENCH = """
title = "Counting"
instruction = "count"
success = ["done"]

[program]
file = "bench.py"
observation = 3

[milestones.done]
text = "It has been told often enough"
when = "reported"

[milestones.begun]
text = "It has been told once"
when = "reported"

[choices.task]
title = "Task"
usual = "seven"
values = ["seven", "three", "never", "refused", "crash", "text"]
"""
PROGRAM = """
import sys

import numpy as np

from runtime.benches.interface import Moment, Refusal

ENDS = {"seven": 7, "three": 3}


class Counting:
    dim, observation, milestones, cameras = 2, 3, ("done", "begun"), ("cam_only",)

    def reset(self, seed, choices):
        if choices["task"] == "refused":
            raise Refusal("task = 'refused': not today")
        self.task, self.seed, self.count, self.row = choices["task"], seed, 0, np.zeros(2)
        return self.moment()

    def step(self, row):
        if self.task == "crash":
            print("out of memory", flush=True)
            sys.stdout.flush()
            import os
            os._exit(7)
        self.count, self.row = self.count + 1, row
        return self.moment()

    def moment(self):
        done = self.count == ENDS.get(self.task)
        over = "success" if done else "20 steps" if self.count == 20 else ""
        seen = np.array([self.count, *self.row], np.float64)
        state = "two" if self.task == "text" else self.row
        return Moment(state, seen, {"done": done, "begun": self.count > 0}, over)

    def observe(self, width, height):
        return {"cam_only": np.full((height, width, 3), [10 * self.count, 0, self.seed], np.uint8)}


def make_bench():
    return Counting()
"""


def make_toy(folder: Path, program: str = PROGRAM, bench: str = BENCH) -> Path:
    """Write the bench and its robot into `folder`, with the tests' own Python as its environment; return the folder.

    EVA_DATA_DIR must be a folder of the test.
    """
    folder.mkdir(parents=True)
    (folder / "bench.toml").write_text(bench)
    (folder / "robot.toml").write_text(ROBOT)
    (folder / "hand.urdf").write_text('<robot name="hand"><link name="table"/></robot>')
    (folder / "requirements.txt").write_text("")
    (folder / "bench.py").write_text(program)
    python = environment_of(str(folder)) / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    python.chmod(0o755)
    return folder


def deployment(folder: Path, tmp_path: Path, more: str = "") -> Path:
    """Write a deployment at the bench in `folder`, in benchmark mode, with a policy of rows that all differ."""
    path = tmp_path / "toy.toml"
    path.write_text(
        f'''
station = "toy"
robot = "{folder}"
task = "count"
data_dir = "{tmp_path / "data"}"

[transport]
kind = "zmq"
simulated = true
bench = "{folder}"
detect_frozen = false

[policy]
kind = "mock"
horizon = 3
amplitude = 0.9

[strategy]
kind = "sync"

[lockstep]
benchmark = true

[safety]
report_only = true

[setup]
home = false

[recording]
min_free_bytes = 0
{more}'''
    )
    return path
