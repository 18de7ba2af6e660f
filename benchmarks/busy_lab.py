"""Lab for measurements: `python -m benchmarks.busy_lab READY_FILE --set KEY=VALUE ...`; ends with Ctrl-C.

Tabletop bench with three cameras of 640x480 at 30 Hz, a policy whose motion never ends, and the web, the worker and the
other processes of any lab. Data are in EVA_DATA_DIR.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import Any

from robots.broken_pipe import exit_on_broken_pipe

ROBOT = "agilex_piper"
_ROOT = Path(__file__).parents[1]
_POLICY = ("--robot", ROBOT, "--port", "0", "--latency-ms", "80")
# Tolerant limits: a machine that stalls must not end the run that measures the stall.
PATIENT = (
    "safety.joint_age_s=10.0",
    "safety.picture_age_s=10.0",
    "safety.following_error=3.0",
    "safety.jump=3.0",
    "safety.refusals_to_hold=1000",
    "control.starvation_hold_s=30.0",
    "control.heartbeat_timeout_s=10.0",
    "control.coordinator_timeout_s=10.0",
    'faults.policy_error="slow"',
    "faults.patience_s=30.0",
    "lease.ttl_s=30.0",
)


@exit_on_broken_pipe
def main() -> int:
    """Run the lab until a signal arrives."""
    import django

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ready_file", type=Path)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="assignments")
    parser.add_argument(
        "--numbered", action="store_true", help="pictures with their numbers instead of a table"
    )
    options = parser.parse_args()
    os.environ.setdefault("DJANGO_SETTINGS_MODULE", "evaweb.settings")
    django.setup()
    from evaweb.lab.lab import open_lab
    from evaweb.lab.lifetime import StopRequested

    try:
        with open_lab("127.0.0.1", 0) as lab:
            _up(lab, options)
            lab.watch()
    except StopRequested:  # the normal end
        return 0
    return 1


def _up(lab: Any, options: argparse.Namespace) -> None:
    from evaweb.accounts.roles import Role
    from evaweb.lab import demo_rows, programs
    from evaweb.lab.benches import Bench
    from evaweb.lab.processes import ProgramSpec
    from runtime.simulation.program import announce_ready

    bench = programs.bench(1, 640, 480)
    if options.numbered:
        bench += ("--bench", "none")
    node = lab.processes.start(programs.tabletop(ROBOT, bench))
    serving = ("-m", "runtime.standins.serve", "openpi", *_POLICY)
    policy = lab.processes.start(ProgramSpec("policy", serving, announces=True))
    assignments = [
        f'transport.sub_endpoint="{node["obs_endpoint"]}"',
        f'transport.pub_endpoint="{node["action_endpoint"]}"',
        f'policy.url="{policy["url"]}"',
        *PATIENT,
        *options.assignments,
    ]
    url = lab.start([Bench(_ROOT / "deployments" / "tabletop.toml", assignments)])
    login = demo_rows.demo_login(username="operator", role=Role.OPERATOR)
    facts = {"url": url, "passwords": {login.username: login.password}, "node": node["obs_endpoint"]}
    announce_ready({**facts, "pids": lab.processes.pids()}, options.ready_file)


if __name__ == "__main__":
    sys.exit(main())
