"""Process that imports everything, builds one robot's kinematics, solves one chunk, and reports the cost.

`python -m benchmarks.first_chunk KIND ROBOT` prints JSON with `rss_mb`, the memory [MB] after solving a chunk of the
home pose.
"""

from __future__ import annotations

import json
import sys

import numpy as np

import robots
from runtime.core.plugins import variants


def main(kind: str, name: str) -> None:
    """Build the kinematics, solve a chunk, and print the result."""
    robot = robots.load_robot(name)
    module = variants("runtime.kinematics")[kind]
    kinematics = module.build(module.Config(), robot)
    home = robot.poses["home"]
    targets = np.repeat(kinematics.forward(home)[None], 50, axis=0)
    result = kinematics.solve(targets, home, 1 / robot.control_rate, home, 0)
    assert result.reached.all()
    print(json.dumps({"rss_mb": _resident_mb()}), flush=True)


def _resident_mb() -> float:
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * 4096 / 1e6


if __name__ == "__main__":
    main(*sys.argv[1:])
