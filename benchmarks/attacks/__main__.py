"""`python -m benchmarks.attacks NAME READY_FILE DATA`: one attack on the lab that is described in READY_FILE.

Prints a line of JSON when the attack has begun and, after the end of standard input, a line with counts of its actions.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

from benchmarks.attacks import bus, crowds, databases, frames, presses, requests
from benchmarks.attacks.target import Target
from robots.broken_pipe import exit_on_broken_pipe
from runtime.simulation.program import stop_event

ATTACKS = {
    "status_flood": bus.status_flood,
    "dead_station": frames.dead_station,
    "viewer_stops": frames.viewer_stops,
    "half_open": requests.half_open,
    "logins": requests.logins,
    "bodies": requests.bodies,
    "toml": requests.toml,
    "slow_json": requests.slow_json,
    "slow_frames": frames.slow_frames,
    "exports": requests.exports,
    "pings": crowds.pings,
    "handshakes": crowds.handshakes,
    "pages": crowds.pages,
    "rest_clients": crowds.rest_clients,
    "made_up_tokens": presses.unknown_tokens,
    "halts": presses.halts,
    "database_hangs": databases.hangs,
}
_NICE = 19


@exit_on_broken_pipe
def main() -> int:
    """Run the attack until standard input ends."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.attacks", description=__doc__)
    parser.add_argument("name", choices=sorted(ATTACKS))
    parser.add_argument("ready_file", type=Path, help="of benchmarks.estop_lab")
    parser.add_argument("data", type=Path, help="folder of that lab")
    parser.add_argument("--database", type=Path, help="folder of its PostgreSQL server, where it has one")
    parser.add_argument("--share", type=float, default=1.0, help="of the whole attack")
    options = parser.parse_args()
    os.nice(_NICE)
    target = _target(options)
    print(json.dumps(ATTACKS[options.name](target)), flush=True)
    os._exit(0)  # without waiting for requests in progress


def _target(options: argparse.Namespace) -> Target:
    lab = json.loads(options.ready_file.read_text("utf-8"))
    return Target(
        url=lab["url"],
        stops=lab["stops"],
        passwords=lab["passwords"],
        data=options.data,
        database=options.database,
        share=options.share,
        begun=lambda: print(json.dumps({"begun": options.name}), flush=True),
        ended=stop_event(lifeline=True),
    )


if __name__ == "__main__":
    sys.exit(main())
