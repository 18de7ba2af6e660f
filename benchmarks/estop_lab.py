"""Lab whose e-stop is pressed: `python -m benchmarks.estop_lab READY_FILE`; ends with Ctrl-C.

Web, worker, a station with a simulated robot and a policy whose motion never ends, and a second station without a
robot.
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
from pathlib import Path
from typing import Any

from robots.broken_pipe import exit_on_broken_pipe

PRESSED, OTHER = "pressed-1", "other-1"
GUESSED_ACCOUNT = (
    "guessed"  # viewer whose password is guessed; other attackers log in while this name is locked
)
_ROBOT = "agilex_piper"
_DEPLOYMENTS = Path(__file__).parents[1] / "deployments"
_FILES = 1024  # Debian's default limit of open files per process
_NOWHERE = "tcp://127.0.0.1:1"
_SETTINGS = (
    "run.duration_s=600",
    "recording.min_free_bytes=0",
    "recording.export=false",
    "safety.joint_age_s=0.5",  # as in deployments/tabletop.toml: bench, web and attackers share the cores
    "safety.picture_age_s=1.0",
)


@exit_on_broken_pipe
def main() -> int:
    """Run the lab until a signal arrives."""
    import django

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ready_file", type=Path)
    options = parser.parse_args()
    os.environ.setdefault("DJANGO_SETTINGS_MODULE", "evaweb.settings")
    django.setup()
    from evaweb.lab.lab import open_lab
    from evaweb.lab.lifetime import StopRequested

    _limit_files()
    try:
        with open_lab("127.0.0.1", 0) as lab:
            _up(lab, options.ready_file)
            lab.watch()
    except StopRequested:  # the normal end
        return 0
    return 1


def _limit_files() -> None:
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(_FILES, most), most))


def _up(lab: Any, ready_file: Path) -> None:
    from evaweb.lab.benches import Bench
    from evaweb.lab.processes import ProgramSpec
    from runtime.simulation.program import announce_ready

    small = ("--robot", _ROBOT, "--width", "64", "--height", "48")
    free = ("--obs-endpoint", "tcp://127.0.0.1:0", "--action-endpoint", "tcp://127.0.0.1:0")
    node = lab.processes.start(
        ProgramSpec("bench", ("-m", "runtime.simulation.node", *small, *free), announces=True)
    )
    serving = (
        "-m",
        "runtime.standins.serve",
        "openpi",
        "--robot",
        _ROBOT,
        "--port",
        "0",
        "--latency-ms",
        "80",
    )
    policy = lab.processes.start(ProgramSpec("policy", serving, announces=True))
    # Programs are named after deployment files: each station needs its own.
    pressed = _bench("demo.toml", PRESSED, node["obs_endpoint"], node["action_endpoint"], policy["url"])
    tabletop = _bench("tabletop.toml", OTHER, _NOWHERE, _NOWHERE, "ws://127.0.0.1:1")
    url = lab.start([Bench(*pressed), Bench(*tabletop)])
    announce_ready({"url": url, "stops": lab.stops, **_people(), "pids": lab.processes.pids()}, ready_file)


def _bench(file: str, station: str, observations: str, actions: str, policy: str) -> tuple[Path, list[str]]:
    ends = (f'transport.sub_endpoint="{observations}"', f'transport.pub_endpoint="{actions}"')
    return _DEPLOYMENTS / file, [f'station="{station}"', *ends, f'policy.url="{policy}"', *_SETTINGS]


def _people() -> dict[str, Any]:
    """Create accounts of each role and GUESSED_ACCOUNT with new passwords, and a token of the operator."""
    from django.contrib.auth.models import User

    from evaweb.accounts.roles import Role
    from evaweb.api.tokens import create_token
    from evaweb.lab.demo_rows import demo_login

    people = {str(role): role for role in Role} | {GUESSED_ACCOUNT: Role.VIEWER}
    logins = [demo_login(username=name, role=role) for name, role in people.items()]
    operator = User.objects.get(username=Role.OPERATOR)
    return {
        "passwords": {login.username: login.password for login in logins},
        "token": create_token(user=operator, name="presses"),
    }


if __name__ == "__main__":
    sys.exit(main())
