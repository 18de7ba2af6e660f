"""A lab on one machine: its processes brought up in order, watched, and ended together."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from django.conf import settings
from django.core.management import call_command

from evaweb.lab import lifetime, programs
from evaweb.lab.processes import LabError, Processes
from evaweb.lab.seed import station_registered
from runtime.deployment import ConfigurationError, load

_WATCH_S = 0.5


@dataclass(frozen=True, slots=True)
class Bench:
    """One station of this lab: its deployment file and what is set on top of it; one that `runs` is started already."""

    deployment: Path
    assignments: Sequence[str] = ()
    runs: bool = False


class Lab:
    """The processes of one machine; `up` starts them, `watch` stays until somebody ends it."""

    def __init__(self, processes: Processes, host: str, port: int) -> None:
        self.processes = processes
        self._host = host
        self._port = port

    def up(self, benches: Sequence[Bench]) -> str:
        """Start worker, stations and web; returns the address of the web."""
        names = [self._register(bench) for bench in benches]
        self.processes.start(programs.worker(["lab", *names]))
        for bench in benches:
            if bench.runs:
                continue
            assignments = [f'data_dir="{settings.DATA_DIR}"', *bench.assignments]
            self.processes.start(programs.station(str(bench.deployment), assignments))
        return str(self.processes.start(programs.web(self._host, self._port))["url"])

    def watch(self) -> None:
        """Restart what dies, until a signal comes."""
        while True:
            self.processes.watch()
            time.sleep(_WATCH_S)

    def _register(self, bench: Bench) -> str:
        try:
            deployment = load(bench.deployment, bench.assignments).deployment
        except ConfigurationError as fault:
            raise LabError(str(fault)) from None
        station = station_registered(
            name=deployment.station,
            robot=deployment.robot,
            deployment=str(bench.deployment),
            simulated=bool(getattr(deployment.transport, "simulated", False)),
        )
        return station.name


@contextmanager
def a_lab(host: str, port: int) -> Iterator[Lab]:
    """A lab that is not up yet, on a migrated database; everything it started ends with the block."""
    if port:
        lifetime.require_free(host, port)
    with lifetime.only_one(settings.DATA_DIR):
        lifetime.end_on_signals()
        call_command("migrate", verbosity=0, interactive=False)
        environment = os.environ | {"EVA_DATA_DIR": str(settings.DATA_DIR), "PYTHONUNBUFFERED": "1"}
        processes = Processes(settings.BASE_DIR, settings.DATA_DIR / "logs", environment)
        try:
            yield Lab(processes, host, port)
        finally:
            processes.end()
