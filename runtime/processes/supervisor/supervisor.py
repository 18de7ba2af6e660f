"""Supervisor of a station: starts the five processes, restarts those that die, and ends them."""

from __future__ import annotations

import json
import logging
import os
import select
import signal
import subprocess
import sys
import time
import uuid
from dataclasses import asdict
from functools import partial
from pathlib import Path
from types import FrameType

from runtime.core.environment import program_environment
from runtime.core.restart_window import MOST_RESTARTS, RestartWindow
from runtime.ipc.bells import Bell
from runtime.ipc.bus import Endpoints, Key
from runtime.ipc.lifeline import Lifeline
from runtime.ipc.membership import rest_s
from runtime.ipc.shared_state import PROCESSES, WOKEN, SharedState
from runtime.link.key_files import known_lab_path
from runtime.processes.supervisor.optional_child import OptionalChild
from runtime.station.lock import acquire_station_lock, unwritable_error
from runtime.station.spec import CAPABILITIES, StationSpec

log = logging.getLogger(__name__)
_MODULES = {
    "guard": "runtime.processes.guard.process",
    "reception": "runtime.processes.reception.process",
    "media": "runtime.processes.media.process",
    "control": "runtime.processes.control.process",
    "coordinator": "runtime.processes.coordinator.process",
    "headless": "runtime.clients.headless",
}
_START_ORDER = ("guard", "reception", "media", "control", "coordinator")
# Optional companions.
_CHANNEL, _LINK, _PANEL = "runtime.clients.channel", "runtime.link", "runtime.clients.panel"
_PATIENCE_S = 9.0  # time for children after the lifeline is cut [s]; then they are killed
_DRIVER_PATIENCE_S = 2.0  # time for the driver of a headless run after its termination [s]
_LOOK_S = 0.2  # period of checks for companions [s]


class Supervisor:
    """Supervisor of one station; every process that it starts ends with it, however it ends."""

    def __init__(self, spec: StationSpec, lifeline: Lifeline | None = None) -> None:
        self._plan = spec
        self._lifeline = lifeline  # of a parent that wants this process to end with it
        self._station_dir = spec.deployment.station_dir
        self._endpoints = Endpoints(self._station_dir)
        self._environment = program_environment(os.environ)
        self._children: dict[str, subprocess.Popen[bytes]] = {}
        self._driver: subprocess.Popen[bytes] | None = None
        self._companions: dict[str, OptionalChild] = {}
        self._restarts = RestartWindow()
        self._ending = False
        self.boot = str(uuid.uuid4())

    def run(self, headless: bool) -> int:
        """Run the station until a signal or the end of a headless run; return the exit code."""
        lock = acquire_station_lock(self._plan.deployment)
        try:
            self._resolved = self._write_resolved()
        except OSError as error:
            raise unwritable_error(self._plan.deployment, error) from None
        self._endpoints.prepare()
        Key(self._station_dir).secret()  # errors of the key are reported before anything moves
        self._shared_state, self._page_fd = SharedState.create(self._plan.layout)
        self._bells, self._signalled = [Bell.create() for _ in WOKEN], Bell.create()
        # Children have the reading end as standard input: it closes when this process ends, however it ends.
        self._lifeline_out, self._lifeline_in = os.pipe()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)
        try:
            if headless:  # the terminal is for a person, so without the log of every process
                self._environment.setdefault("EVA_LOG_LEVEL", "WARNING")
            for process in _START_ORDER:
                self._start(process)
            if self._plan.deployment.control_channel.enabled:
                self._companions["channel"] = OptionalChild(
                    "channel", partial(self._spawn_companion, _CHANNEL)
                )
            if self._plan.deployment.panel is not None:
                self._companions["panel"] = OptionalChild("panel", partial(self._spawn_companion, _PANEL))
            if headless:
                self._driver = self._spawn("headless")
            return self._watch()
        finally:
            self._end()
            lock.close()

    def _write_resolved(self) -> Path:
        path = self._station_dir / "resolved.json"
        path.write_text(json.dumps(dict(self._plan.resolved.tree), indent=1), "utf-8")
        return path

    def _start(self, process: str) -> None:
        self._shared_state.beat(process, 0.0)  # not alive before its own first heartbeat
        self._shared_state.set_generation(process, self._shared_state.generation(process) + 1)
        self._children[process] = self._spawn(process)
        self._write_endpoints()

    def _write_endpoints(self) -> None:
        pids = {name: str(child.pid) for name, child in self._children.items()}
        self._endpoints.write("supervisor", {"boot": self.boot, **pids})

    def _spawn(self, process: str) -> subprocess.Popen[bytes]:
        inherited = () if process == "headless" else (self._page_fd, *(b.descriptor for b in self._bells))
        rung = ",".join(map(str, inherited[1:]))
        shared = ("--shared", str(self._page_fd), "--bells", rung) if inherited else ()
        return subprocess.Popen(
            [
                *(sys.executable, "-m", _MODULES[process], "--boot", self.boot),
                *(self._guard_arguments() if process == "guard" else self._reader_arguments(process)),
                *shared,
            ],
            stdin=self._lifeline_out,
            pass_fds=inherited,
            env=self._environment,
            start_new_session=True,  # Ctrl-C reaches only the supervisor, which ends the children in order
        )

    def _reader_arguments(self, process: str) -> tuple[str, ...]:
        capabilities = CAPABILITIES.dump_json(self._plan.capabilities).decode()
        return (
            "--resolved",
            str(self._resolved),
            *(() if process == "headless" else ("--capabilities", capabilities)),
        )

    def _guard_arguments(self) -> tuple[str, ...]:
        """Return the guard's arguments as plain values.

        The guard reads no deployment, because that may name modules that fail to load.
        """
        spec, control = self._plan, self._plan.deployment.control
        punctual = control.realtime == "auto" and spec.capabilities.moves_robot
        return (
            *(("--priority", str(control.realtime_priority)) if punctual else ()),
            *("--station", spec.deployment.station, "--folder", str(self._station_dir)),
            *("--period", repr(1.0 / spec.rate), "--layout", json.dumps(asdict(spec.layout))),
            *("--rest", repr(rest_s(control.heartbeat_timeout_s))),
        )

    def _spawn_companion(self, module: str) -> subprocess.Popen[bytes]:
        """Start a companion (control channel, link to a lab, panel): a client without access to shared state."""
        station, data = self._plan.deployment.station, str(self._plan.deployment.data)
        return subprocess.Popen(
            [sys.executable, "-m", module, station, "--data-dir", data, "--lifeline"],
            stdin=self._lifeline_out,
            env=self._environment,
            start_new_session=True,
        )

    def _watch(self) -> int:
        while not self._ending and not (self._lifeline and self._lifeline.is_cut):
            if self._driver is not None and self._driver.poll() is not None:
                return self._driver.returncode
            for process in PROCESSES:
                code = self._children[process].poll()
                if code is not None and not self._restart(process, code):
                    return 1
            if "link" not in self._companions and known_lab_path(self._station_dir).exists():
                self._companions["link"] = OptionalChild("link", partial(self._spawn_companion, _LINK))
            for companion in self._companions.values():
                companion.poll()
            if self._endpoints.is_missing("supervisor"):
                self._write_endpoints()
            self._sleep()
        return 130

    def _sleep(self) -> None:
        """Wait for the end of a child, a signal, the end of our own parent, or the next check."""
        children = [*self._children.values(), *([self._driver] if self._driver else [])]
        ends = [os.pidfd_open(child.pid) for child in children if child.returncode is None]
        try:
            lives = [self._lifeline.descriptor] if self._lifeline else []
            select.select([*ends, *lives, self._signalled.descriptor], [], [], _LOOK_S)
        finally:
            for end in ends:
                os.close(end)

    def _restart(self, process: str, code: int) -> bool:
        if not self._restarts.admit(time.monotonic()):
            log.error(
                "%s ended with %d; %d restarts within a minute: giving up", process, code, MOST_RESTARTS
            )
            return False
        log.error("%s ended with %d: restarting it", process, code)
        self._start(process)
        return True

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._ending = True
        self._signalled.ring()

    def _end(self) -> None:
        """End all children.

        The driver, which commands the station, ends first; then the lifeline is cut, which ends the rest. Each child
        then closes its files, and control holds for its orphan time. Children that do not end in time are killed.
        """
        if self._driver is not None and self._driver.poll() is None:
            self._driver.terminate()
            self._wait_for_exit("headless", self._driver, _DRIVER_PATIENCE_S)
        os.close(self._lifeline_in)
        deadline = time.monotonic() + _PATIENCE_S
        for process, child in self._children.items():
            self._wait_for_exit(process, child, max(0.1, deadline - time.monotonic()))
        for name, companion in self._companions.items():
            self._wait_for_exit(name, companion.process, _DRIVER_PATIENCE_S)
        os.close(self._lifeline_out)
        os.close(self._page_fd)
        for bell in (*self._bells, self._signalled):
            bell.close()
        self._endpoints.clear()

    def _wait_for_exit(self, process: str, child: subprocess.Popen[bytes], seconds: float) -> None:
        try:
            child.wait(seconds)
        except subprocess.TimeoutExpired:
            log.error("%s does not end: killed", process)
            child.kill()
            child.wait()
