"""Lab on one machine: its processes started in order, watched, and ended together."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from django.conf import settings
from django.core.management import call_command

from evaweb.jobs.workers import lab_folder_named
from evaweb.lab import first_account, lifetime, programs
from evaweb.lab.benches import Bench, program_of, registered
from evaweb.lab.pickup import Pickup
from evaweb.lab.processes import ChildProcesses
from evaweb.lab.progress import Progress, silent
from evaweb.lab.simulated import Benches
from evaweb.serving.listeners import open_listener
from evaweb.serving.stop_port import StopPort, remove_stop_port
from runtime.core.environment import program_environment

_WATCH_S = 0.5


class Lab:
    """Processes of one machine; `start` starts them, `watch` blocks until the lab is ended."""

    STEPS = 3  # progress steps of a start, plus one per station

    def __init__(
        self, processes: ChildProcesses, host: str, port: int, listener: socket.socket, progress: Progress
    ) -> None:
        """Start worker and web at once, so that a second core starts them in parallel with benches and stations.

        `listener` is the listening socket of the process that answers stops. It stays open as long as the lab, so that
        stop requests wait in it while that process restarts.
        """
        self.processes, self.progress = processes, progress
        self._listener = listener
        self.stops = ""  # address of the process for stops, once it is up
        self.processes.start(programs.worker())
        self._web = self.processes.begin(programs.web(host, port))

    def start(self, benches: Sequence[Bench]) -> str:
        """Start the stations and the process for stops; return the address of the web."""
        names = [registered(bench) for bench in benches]
        for name, bench in zip(names, benches, strict=True):
            with self.progress.step(f"the station {name}"):
                if not bench.runs:
                    self.processes.start(program_of(bench))
        with self.progress.step("the web"):
            web = self._web()
            web_port = programs.port_of(web)
        if settings.EVA_GATE is not None:
            with self.progress.during("the gate"):
                self.processes.start(programs.gate(*settings.EVA_GATE))
        with self.progress.step("the process for stops"):
            StopPort(self._listener.getsockname()[1], int(web_port)).start()
            stops = programs.stops(self._listener.fileno(), web_port)
            self.stops = str(self.processes.start(stops)["url"])
        return str(web["url"])

    def watch(self, how: Benches | None = None) -> None:
        """Restart processes that end, and start new deployments of the data folder, until a signal arrives.

        `how` are the settings of the simulated benches that it starts.
        """
        pickup = Pickup(self.processes, how or Benches())
        while True:
            self.processes.watch()
            pickup.poll()
            time.sleep(_WATCH_S)


@contextmanager
def open_lab(
    host: str, port: int, stop_port: int | None = None, progress: Progress | None = None
) -> Iterator[Lab]:
    """Yield a lab on a migrated database; everything that it started ends with the block.

    `stop_port` defaults to the port after `port`. Port 0 is a free port.
    """
    reporter = progress or silent()
    if stop_port is None:
        stop_port = port + 1 if port else 0
    for number, option in ((port, "--port"), (stop_port, "--stop-port")):
        if number:
            lifetime.require_free(host, number, option)
    with lifetime.hold_data_folder(settings.DATA_DIR):
        lifetime.end_on_signals()
        with reporter.step("the database"):
            call_command("migrate", verbosity=0, interactive=False)
            lab_folder_named()
        environment = program_environment(os.environ) | {
            "EVA_DATA_DIR": str(settings.DATA_DIR),
            "PYTHONUNBUFFERED": "1",
        }
        processes = ChildProcesses(settings.BASE_DIR, settings.DATA_DIR / "logs", environment)
        with open_listener(host, stop_port, "--stop-port") as listener:
            try:
                yield Lab(processes, host, port, listener, reporter)
            finally:
                with reporter.during("ending"):
                    processes.end()
                first_account.withdraw()
                remove_stop_port()
