"""Compilation of the renderer in advance, so that no start of a simulated node waits for it."""

from __future__ import annotations

import sys
import time

import robots
from runtime.simulation.bench.bench import Bench
from runtime.simulation.render.renderer import Renderer


def main() -> int:
    """Compile for this processor; images of any robot, bench and size need the same code."""
    begun = time.perf_counter()
    Renderer(robots.load_robot(robots.robot_names()[0]), Bench(), 64, 48)
    print(f"renderer: ready after {time.perf_counter() - begun:.1f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
