"""`python -m runtime DEPLOYMENT`: check, run in lockstep, or start a station's family of processes."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from runtime import deployment, lockstep, log
from runtime.errors import RuntimeFault
from runtime.family import Lifeline, Plan, plan
from runtime.session import State
from runtime.supervisor import Supervisor


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code 0 where all went well, 1 where the run failed, 2 where the deployment is wrong."""
    parser = argparse.ArgumentParser(prog="python -m runtime", description=__doc__)
    parser.add_argument("deployment", type=Path, help="a TOML file; deployments/ has examples")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="assignments")
    parser.add_argument("--lifeline", action="store_true", help="end when standard input ends")
    how = parser.add_mutually_exclusive_group()
    how.add_argument(
        "--check", action="store_true", help="print the resolved deployment and its hash, start nothing"
    )
    how.add_argument("--lockstep", action="store_true", help="one process on a virtual clock")
    how.add_argument(
        "--headless", action="store_true", help="set up, run once, publish, end; holds the lease itself"
    )
    given = parser.parse_args(arguments)
    log.start("supervisor")
    try:
        made = plan(deployment.load(given.deployment, given.assignments))
    except RuntimeFault as fault:
        print(fault, file=sys.stderr)
        return 2
    try:
        if given.check:
            return _check(made)
        if given.lockstep:
            return run_in_lockstep(made)
        return Supervisor(made, Lifeline() if given.lifeline else None).run(given.headless)
    except RuntimeFault as fault:
        print(f"error: {fault}", file=sys.stderr)
        return 1


def _check(made: Plan) -> int:
    print(json.dumps(dict(made.resolved.tree), indent=1))
    print(f"hash {made.resolved.digest}")
    robot = made.robot
    counts = f"{robot.dim} joints, {len(robot.cameras)} cameras"
    print(f"ok: {robot.name}, {counts}, {made.rate:g} Hz, {made.fps:g} fps")
    return 0


def run_in_lockstep(made: Plan) -> int:
    """Run, print how it went, publish what ended well; returns the exit code."""
    done = lockstep.run(made)
    episode = done.episode
    print(f"{done.state}: {done.reason}")
    print(
        f"episode  {episode.get('path', 'none')}  {episode.get('rows', 0)} rows, {episode.get('status', '')}"
    )
    # A run that held was ended by nobody's judgement: it is kept, but neither published nor a success.
    well = done.state is State.READY and episode.get("status", "finished") == "finished"
    if well and made.deployment.publish.dataset and episode:
        from runtime.datasets.published import publish

        published = publish(Path(episode["path"]), made.deployment.data / made.deployment.publish.dataset)
        print(f"dataset  {published.dataset}  episode {published.episode_index}, {published.frames} frames")
    return 0 if well else 1


if __name__ == "__main__":
    sys.exit(main())
