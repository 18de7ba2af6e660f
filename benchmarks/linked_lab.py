"""`python -m benchmarks.linked_lab READY_FILE`: a lab whose stations are on other computers; runs until a signal."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from benchmarks.climb import MOST_STATIONS
from benchmarks.estop_lab import PRESSED
from robots.broken_pipe import exit_on_broken_pipe

STATIONS = (PRESSED, *(f"more-{number}" for number in range(1, MOST_STATIONS)))
_ROBOT = "agilex_piper"


@exit_on_broken_pipe
def main() -> int:
    """Start the lab; announce addresses, accounts, and an enrolment code for each of STATIONS."""
    import django

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ready_file", type=Path)
    options = parser.parse_args()
    os.environ.setdefault("DJANGO_SETTINGS_MODULE", "evaweb.settings")
    django.setup()
    from evaweb.lab.lab import open_lab
    from evaweb.lab.lifetime import StopRequested

    try:
        with open_lab("127.0.0.1", 0) as lab:
            url = lab.start([])
            pids = lab.processes.pids()
            _announce(options.ready_file, url, lab.stops, pids)
            lab.watch()
    except StopRequested:
        return 0
    return 1


def _announce(ready_file: Path, url: str, stops: str, pids: dict[str, int]) -> None:
    from django.contrib.auth.models import User

    from evaweb.accounts.roles import Role
    from evaweb.lab.demo_rows import demo_login, station_registered
    from evaweb.stations.enrolment import code_make
    from runtime.simulation.program import announce_ready

    logins = [demo_login(username=str(role), role=role) for role in (Role.OPERATOR, Role.ADMIN)]
    admin, enrol = User.objects.get(username=Role.ADMIN), {}
    for name in STATIONS:
        station = station_registered(name=name, robot=_ROBOT, deployment="", simulated=True)
        enrolment = code_make(user=admin, station=station)
        enrol[name] = [enrolment.address, enrolment.code]
    passwords = {login.username: login.password for login in logins}
    announce_ready(
        {"url": url, "stops": stops, "passwords": passwords, "enrol": enrol, "pids": pids}, ready_file
    )


if __name__ == "__main__":
    sys.exit(main())
