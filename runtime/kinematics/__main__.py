"""Compilation of the kinematics of robots in advance, so that no start of a station and no command waits for it."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence

import robots
from robots.broken_pipe import exit_on_broken_pipe
from runtime.core.errors import RuntimeFault
from runtime.kinematics import compiled


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Compile for the named robots, or for all if none are named; return 1 if that fails for one of them."""
    parser = argparse.ArgumentParser(prog="python -m runtime.kinematics", description=__doc__)
    parser.add_argument("robots", metavar="ROBOT", nargs="*", help="a robot's name or a folder")
    names = parser.parse_args(arguments).robots or robots.robot_names()
    try:
        for name in names:
            begun = time.perf_counter()
            for robot in (
                robots.load_robot(name),
                robots.load_robot_with_optional_groups(name),
            ):  # another torso needs another solver
                compiled.build(compiled.Config(), robot)
            print(f"{name}: ready after {time.perf_counter() - begun:.1f} s")
    except (robots.RobotError, RuntimeFault) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
