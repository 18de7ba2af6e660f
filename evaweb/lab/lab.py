"""A lab on one machine: its processes brought up in order, watched, and ended together."""

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
from evaweb.listening import open_listener
from evaweb.stop_port import StopPort, remove_stop_port
from runtime.core.environment import program_environment

_WATCH_S = 0.5


class Lab:
    """The processes of one machine; `up` starts them, `watch` stays until it is ended."""

    STEPS = 3  # of a start, and one for each station

    def __init__(
        self, processes: ChildProcesses, host: str, port: int, listener: socket.socket, progress: Progress
    ) -> None:
        """Worker and web begin at once: a machine with a second core starts them beside benches and stations.

        `listener` is that of stops: open as long as the lab, so that presses wait in it for a restarted process.
        """
        self.processes, self.progress = processes, progress
        self._listener = listener
        self.stops = ""  # the address of the process for stops, once it is up
        self.processes.start(programs.worker())
        self._web = self.processes.begin(programs.web(host, port))

    def start(self, benches: Sequence[Bench]) -> str:
        """Start the stations and the process for stops; returns the address of the web."""
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
        """Restart what dies, and start what is written into the folder of deployments, until a signal comes."""
        pickup = Pickup(self.processes, how or Benches())
        while True:
            self.processes.watch()
            pickup.look()
            time.sleep(_WATCH_S)


@contextmanager
def open_lab(
    host: str, port: int, stop_port: int | None = None, progress: Progress | None = None
) -> Iterator[Lab]:
    """A lab that is coming up, on a migrated database; everything it started ends with the block.

    `stop_port` is by itself the one after `port`. Port 0 takes a free one.
    """
    told = progress or silent()
    if stop_port is None:
        stop_port = port + 1 if port else 0
    for wanted, option in ((port, "--port"), (stop_port, "--stop-port")):
        if wanted:
            lifetime.require_free(host, wanted, option)
    with lifetime.hold_data_folder(settings.DATA_DIR):
        lifetime.end_on_signals()
        with told.step("the database"):
            call_command("migrate", verbosity=0, interactive=False)
            lab_folder_named()
        environment = program_environment(os.environ) | {
            "EVA_DATA_DIR": str(settings.DATA_DIR),
            "PYTHONUNBUFFERED": "1",
        }
        processes = ChildProcesses(settings.BASE_DIR, settings.DATA_DIR / "logs", environment)
        with open_listener(host, stop_port) as listener:
            try:
                yield Lab(processes, host, port, listener, told)
            finally:
                with told.during("ending"):
                    processes.end()
                first_account.withdraw()
                remove_stop_port()
