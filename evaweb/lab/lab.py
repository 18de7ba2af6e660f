"""A lab on one machine: its processes brought up in order, watched, and ended together."""

from __future__ import annotations

import os
import socket
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
from evaweb.listening import listen
from evaweb.stop_port import StopPort, forget
from runtime.config.loader import ConfigurationError, load
from runtime.core.environment import for_programs

_WATCH_S = 0.5


@dataclass(frozen=True, slots=True)
class Bench:
    """One station of this lab: its deployment file and what is set on top of it; one that `runs` is started already."""

    deployment: Path
    assignments: Sequence[str] = ()
    runs: bool = False


class Lab:
    """The processes of one machine; `up` starts them, `watch` stays until it is ended."""

    def __init__(self, processes: Processes, host: str, port: int, listener: socket.socket) -> None:
        """`listener` is that of stops: open as long as the lab, so that presses wait in it for a restarted process."""
        self.processes = processes
        self._host, self._port, self._listener = host, port, listener
        self.stops = ""  # the address of the process for stops, once it is up

    def up(self, benches: Sequence[Bench]) -> str:
        """Start worker, stations, web and the process for stops; returns the address of the web."""
        names = [self._register(bench) for bench in benches]
        self.processes.start(programs.worker(["lab", *names]))
        for bench in benches:
            if bench.runs:
                continue
            assignments = [f'data_dir="{settings.DATA_DIR}"', *bench.assignments]
            self.processes.start(programs.station(str(bench.deployment), assignments))
        web = self.processes.start(programs.web(self._host, self._port))
        web_port = programs.port_of(web)
        StopPort(self._listener.getsockname()[1], int(web_port)).start()
        stops = programs.stops(self._listener.fileno(), web_port)
        self.stops = str(self.processes.start(stops)["url"])
        return str(web["url"])

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
def a_lab(host: str, port: int, stop_port: int | None = None) -> Iterator[Lab]:
    """A lab that is not up yet, on a migrated database; everything it started ends with the block.

    `stop_port` is by itself the one after `port`. Port 0 takes a free one.
    """
    if stop_port is None:
        stop_port = port + 1 if port else 0
    for wanted, option in ((port, "--port"), (stop_port, "--stop-port")):
        if wanted:
            lifetime.require_free(host, wanted, option)
    with lifetime.only_one(settings.DATA_DIR):
        lifetime.end_on_signals()
        call_command("migrate", verbosity=0, interactive=False)
        environment = for_programs(os.environ) | {
            "EVA_DATA_DIR": str(settings.DATA_DIR),
            "PYTHONUNBUFFERED": "1",
        }
        processes = Processes(settings.BASE_DIR, settings.DATA_DIR / "logs", environment)
        with listen(host, stop_port) as listener:
            try:
                yield Lab(processes, host, port, listener)
            finally:
                processes.end()
                forget()
