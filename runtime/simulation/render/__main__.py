"""Compilation of the renderer in advance, so that no start of a simulated node waits for it."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence

import robots
from robots.broken_pipe import exit_on_broken_pipe
from runtime.simulation.bench.bench import Bench
from runtime.simulation.render.renderer import Renderer


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Compile for this processor; images of any robot, bench and size need the same code."""
    argparse.ArgumentParser(prog="python -m runtime.simulation.render", description=__doc__).parse_args(
        arguments
    )
    begun = time.perf_counter()
    Renderer(robots.load_robot(robots.robot_names()[0]), Bench(), 64, 48)
    print(f"renderer: ready after {time.perf_counter() - begun:.1f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
