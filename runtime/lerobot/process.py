"""Child process of a station with one LeRobot device, run by the Python of LeRobot's environment.

The child (`runtime.lerobot.host`) is started again when it ends, with growing pauses. It ends with this process,
however this process ends.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import logging
import math
import os
import shutil
import signal
import subprocess
import threading
import time
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from runtime.core import realtime
from runtime.core.backoff import BackOff
from runtime.core.environment import foreign_python_environment
from runtime.core.errors import SetupError
from runtime.ipc.endpoints import socket_folder
from runtime.lerobot.devices import LOST

log = logging.getLogger(__name__)
_HOST = "runtime.lerobot.host"
_NEEDED = ("lerobot", "numpy", "zmq", "msgpack")
_CHECK = f"""
import importlib.util
print(*(name for name in {_NEEDED} if importlib.util.find_spec(name) is None))
"""
_CHECK_S = 20.0
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 20.0  # each start imports torch
_END_S = 5.0  # time of a child to disconnect its device [s]
_LAST_WORDS_S = 1.0  # to read what a child that has ended has written [s]
_STEADY_S = 30.0  # connection after which the next start does not wait longer [s]
_LAST_LINES = 30
_LONGEST_LINE = 2000  # characters
_STARTING = "its process is being started"


@functools.cache  # cache: to look starts a process
def require_lerobot(python: str, key: str) -> None:
    """Raise SetupError unless `python`, which is `key` in the deployment, can run the host; a success is cached."""
    try:
        environment = foreign_python_environment() | {"PYTHONSAFEPATH": "1"}  # as for the host
        done = subprocess.run(
            [python, "-c", _CHECK],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_CHECK_S,
            env=environment,
            check=True,
        )
    except (OSError, subprocess.SubprocessError) as error:
        raise SetupError(
            f"{key} = {python!r} cannot be run: {error}; allowed: the Python of an environment with lerobot, "
            "numpy, pyzmq and msgpack"
        ) from error
    if missing := done.stdout.split():
        raise SetupError(
            f"{key} = {python!r} lacks {', '.join(missing)}; install there: lerobot (with the extra of the device), "
            "pyzmq, msgpack"
        )


@dataclass(frozen=True, slots=True)
class HostEndpoints:
    """Endpoints of one host, in a folder that only this account can enter."""

    folder: Path

    @classmethod
    def of_station(cls, settings: str) -> HostEndpoints:
        """Return the endpoints of the transport with these settings.

        They are the same in all processes of a station, which are children of one supervisor, and differ between
        stations. Raises TransportError if there is no usable folder.
        """
        digest = hashlib.sha256(settings.encode()).hexdigest()
        return cls(socket_folder(Path(f"lerobot-{os.getppid()}-{digest}")))

    @classmethod
    def of_process(cls, name: str) -> HostEndpoints:
        """Return the endpoints of the device `name` of this process. Raises TransportError if no folder is usable."""
        return cls(socket_folder(Path(f"lerobot-{os.getpid()}-of-{name}")))

    @property
    def observations(self) -> str:
        return f"ipc://{self.folder}/observations"

    @property
    def commands(self) -> str:
        return f"ipc://{self.folder}/commands"


class HostProcess:
    """Child process with one device; a thread starts it, reads its reports, and starts it again."""

    def __init__(self, python: str, endpoints: HostEndpoints, settings: Mapping[str, Any]) -> None:
        self._python, self._endpoints = python, endpoints
        self._settings = {**settings, "observations": endpoints.observations}
        self._lock = threading.Lock()
        self._problem = _STARTING
        self._faults: Counter[str] = Counter()
        self._sentences: dict[str, str] = {}
        self._ending = threading.Event()
        self._child: subprocess.Popen[bytes] | None = None
        self._has_reason = False  # the child has reported why its device gives nothing
        self._connected_at = math.inf  # [s]
        self._thread: threading.Thread | None = None

    @property
    def problem(self) -> str:
        """Reason why the device gives nothing, "" if it is connected."""
        with self._lock:
            return self._problem

    @property
    def is_starting(self) -> bool:
        """Return True until the first report: importing LeRobot and connecting the device take seconds."""
        return self.problem == _STARTING

    def faults(self) -> dict[str, int]:
        """Return the number of observations that were not passed on, by reason."""
        with self._lock:
            return dict(self._faults)

    def describe_fault(self, fault: str) -> str:
        """Return a sentence about the latest occurrence of a fault, "" if there was none."""
        with self._lock:
            return self._sentences.get(fault, "")

    def start(self) -> None:
        """Start the child, without waiting for it. Safe to call twice."""
        if self._thread is None:
            self._ending.clear()
            self._set_problem(_STARTING)
            self._thread = threading.Thread(target=self._run, name="lerobot", daemon=True)
            self._thread.start()

    def request_stop(self) -> None:
        """Request the end of the child, without waiting for it."""
        self._ending.set()
        with self._lock:
            if self._child is not None:
                _close(self._child.stdin)

    def stop(self) -> None:
        """End the child: its device has a moment to disconnect. Safe to call twice."""
        self.request_stop()
        if self._thread is None:
            return
        self._thread.join(_END_S)
        with self._lock:
            if self._child is not None:
                _end_session(self._child)
        self._thread.join(_END_S)
        self._thread = None
        shutil.rmtree(self._endpoints.folder, ignore_errors=True)

    def _run(self) -> None:
        """Run the thread."""
        realtime.leave_realtime()  # a child has the class of the thread that starts it
        back_off = BackOff(_FIRST_PAUSE_S, _LONGEST_PAUSE_S)
        while not self._ending.is_set():
            try:
                self._run_child(back_off)
            except (OSError, SetupError) as error:
                self._set_problem(f"{self._python} cannot be run: {error}")
            except Exception as error:  # nothing else would start the child again
                log.exception("reading LeRobot's process failed")
                self._set_problem(f"reading its process failed: {type(error).__name__}: {error}")
            back_off.record_failure(time.monotonic())
            self._ending.wait(back_off.remaining_delay(time.monotonic()))

    def _run_child(self, back_off: BackOff) -> None:
        self._endpoints.folder.mkdir(mode=0o700, exist_ok=True)  # a host removes it at its end
        child = subprocess.Popen(
            [self._python, "-m", _HOST],
            stdin=subprocess.PIPE,  # its end ends the child, however this process ends
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=foreign_python_environment() | {"PYTHONSAFEPATH": "1"},
            start_new_session=True,  # Ctrl-C goes to the station, which may still have to stop a robot
        )
        assert child.stdin is not None
        assert child.stdout is not None
        assert child.stderr is not None
        lines: deque[str] = deque(maxlen=_LAST_LINES)
        output = threading.Thread(target=_read_output, args=(child.stderr, lines), daemon=True)
        output.start()
        with self._lock:
            self._child = child
        with contextlib.suppress(OSError):
            child.stdin.write(json.dumps(self._settings).encode() + b"\n")
            child.stdin.flush()
        if self._ending.is_set():  # `request_stop` ran before it could see this child
            _close(child.stdin)
        self._has_reason, self._connected_at = False, math.inf
        reports = threading.Thread(target=self._read_reports, args=(child.stdout,), daemon=True)
        reports.start()
        # Not the end of its output: a driver's own processes may have inherited that.
        os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
        with self._lock:
            _end_session(child)
            code = child.wait()
            self._child = None
        for thread in (reports, output):
            thread.join(_LAST_WORDS_S)
        _close(child.stdin)
        if time.monotonic() - self._connected_at > _STEADY_S:
            back_off.reset()
        if not self._ending.is_set():
            last = lines[-1] if lines else "it wrote nothing"
            if not (self._has_reason and self.problem):  # else the reason is known better
                self._set_problem(f"its process has ended ({code}): {last}")
            if code != LOST or not self._has_reason:
                log.warning("LeRobot's process has ended (%d): %s", code, " / ".join(lines))

    def _read_reports(self, stream: IO[bytes]) -> None:
        for line in stream:
            try:
                fields = json.loads(line)
            except ValueError:  # not of the host
                continue
            if "fault" in fields:
                with self._lock:
                    self._faults[fields["fault"]] += 1
                    self._sentences[fields["fault"]] = fields["text"]
                continue
            if not fields["problem"]:
                self._connected_at = time.monotonic()
            self._has_reason = bool(fields["problem"])
            self._set_problem(fields["problem"])

    def _set_problem(self, problem: str) -> None:
        with self._lock:
            changed, self._problem = problem != self._problem, problem
        if changed:
            log.info("LeRobot's device: %s", problem or "connected")


def _end_session(child: subprocess.Popen[bytes]) -> None:
    """Kill a child and what it has started; they are a session of their own."""
    with contextlib.suppress(OSError):  # none of them is left
        os.killpg(child.pid, signal.SIGKILL)


def _read_output(stream: IO[bytes], lines: deque[str]) -> None:
    while line := stream.readline(_LONGEST_LINE):
        if text := line.decode("utf-8", "replace").strip():
            lines.append(text)
            log.debug("lerobot: %s", text)


def _close(stream: IO[bytes] | None) -> None:
    if stream is not None:
        with contextlib.suppress(OSError):
            stream.close()
