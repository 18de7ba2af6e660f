"""Preflights in child processes, so that none can delay or end the caller."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from runtime.config.loader import Resolved, apply_changes
from runtime.config.schema import Deployment
from runtime.core.environment import without_web_secrets
from runtime.core.errors import RuntimeFault
from runtime.core.sentences import Pattern, fixed
from runtime.ipc.command_arguments import PreflightRequest

_UNDER_WAY = Pattern("preflight.under_way", "a preflight of {about} is under way: wait for it")
_NOT_STARTED = Pattern("preflight.not_started", "the process of a preflight cannot be started: {error}")
_CANCELLED = Pattern("preflight.cancelled", "cancelled: {why}")
_NOT_IN_TIME = fixed("preflight.not_in_time", "it did not end in time")
_UNKNOWN = Pattern(
    "preflight.unknown",
    "preflight {identity!r:.80} is not known here; the last {kept} since the start are kept",
)
_STATION_ENDS = fixed("preflight.station_ends", "the station ends")
_UNREADABLE = fixed(
    "preflight.unreadable",
    "the station failed to read what its process said: see the station's log",
)
_SAID_NOTHING = Pattern("preflight.said_nothing", "its process exited with {code} and no output")

_ROOM_S = 10.0  # [s] beside the policy's own deadlines: kinematics, a slow machine
_GRACE_S = 180.0  # [s] after the deadline, for a process that compiles kinematics
_KEPT = 20  # stored reports; the oldest is dropped first
Spawn = Callable[[], "subprocess.Popen[bytes]"]


@dataclass(slots=True)
class PreflightRun:
    """State of one preflight, which runs in a child process until `over` is set.

    After that, either `finished` has the report, or `failure` is the reason why there is no report.
    """

    id: str
    about: str
    child: subprocess.Popen[bytes]
    ends: float  # time of the kill on time.monotonic [s]
    finished: dict[str, Any] = field(default_factory=dict)
    failure: str = ""
    over: threading.Event = field(default_factory=threading.Event)

    def end(self, why: str) -> None:
        """Kill the process; `why` takes the place of its report."""
        self.failure = why
        self.child.kill()

    def to_dict(self) -> dict[str, Any]:
        """Return the answer to a query: `running`, `report` (or null), and `failure`."""
        return {"running": not self.over.is_set(), "report": self.finished or None, "failure": self.failure}


class Preflights:
    """Preflights of a station, one at a time. Call `poll` regularly. Use it from one thread only."""

    def __init__(self, spawn: Spawn | None = None, now: Callable[[], float] = time.monotonic) -> None:
        self._spawn = spawn or _spawn_child
        self._now = now
        self._flight: PreflightRun | None = None
        self._kept: dict[str, PreflightRun] = {}

    @property
    def current(self) -> str:
        """Name of what the running preflight is about, "" if no preflight is running."""
        return self._flight.about if self._flight else ""

    def start(self, asked: PreflightRequest, resolved: Resolved) -> float:
        """Start a preflight; return the longest time until its end [s], compilation included.

        Whether the request results in a valid deployment is not checked here; the report states it.

        Raises:
            RuntimeFault: Another preflight is running, or the process cannot be started.
        """
        if asked.id in self._kept:  # a repeated request: the answer to the first was lost
            return max(0.0, self._kept[asked.id].ends - self._now())
        if self._flight is not None:
            raise RuntimeFault(_UNDER_WAY(about=self._flight.about))
        deadline = asked.deadline_s or _deadline_for(resolved, asked)
        line = {"tree": dict(resolved.tree), "changes": asked.changes, "deadline_s": deadline}
        try:
            child = self._spawn()
        except OSError as error:
            raise RuntimeFault(_NOT_STARTED(error=error)) from error
        longest = deadline + _GRACE_S
        self._flight = flight = PreflightRun(asked.id, asked.about, child, self._now() + longest)
        self._kept[asked.id] = flight
        for old in list(self._kept)[:-_KEPT]:
            del self._kept[old]
        threading.Thread(target=_supervise, args=(flight, line), name="preflight", daemon=True).start()
        return longest

    def poll(self) -> PreflightRun | None:
        """Return a preflight that has ended since the last call, else None; kill a preflight whose time is over."""
        flight = self._flight
        if flight is None:
            return None
        if flight.over.is_set():
            self._flight = None
            return flight
        if self._now() > flight.ends and not flight.failure:
            flight.end(_NOT_IN_TIME)
        return None

    def cancel(self, why: str) -> None:
        """Kill the running preflight, if there is one."""
        if self._flight is not None and not self._flight.failure:
            self._flight.end(_CANCELLED(why=why))

    def report(self, id: str) -> dict[str, Any]:
        """Return the state of a preflight as `PreflightRun.to_dict`. Raises RuntimeFault if its id is unknown."""
        if id not in self._kept:
            raise RuntimeFault(_UNKNOWN(identity=id, kept=_KEPT))
        return self._kept[id].to_dict()

    def close(self) -> None:
        """Kill the running preflight and wait for its end."""
        flight = self._flight
        if flight is not None:
            self.cancel(_STATION_ENDS)
            flight.over.wait(2.0)


def _deadline_for(resolved: Resolved, request: PreflightRequest) -> float:
    """Return the longest time for the policy [s]: the sum of its deadlines.

    For an invalid deployment it is a default; the preflight's process reports what is invalid.
    """
    try:
        return default_deadline(apply_changes(resolved, request.changes, "preflight").deployment)
    except RuntimeFault:
        return 30.0


def _spawn_child() -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "runtime.preflight", "--given"],
        stdin=subprocess.PIPE,  # the child ends when we close it
        stdout=subprocess.PIPE,
        env=without_web_secrets(os.environ),  # a worker's environment has the web's secrets
    )


def run_preflight(asked: Mapping[str, Any], longest: float) -> dict[str, Any]:
    """Run a preflight as by `python -m runtime.preflight --given` and return its report, after at most `longest` [s].

    Raises RuntimeFault if its process ends without a report.
    """
    child = _spawn_child()
    late = threading.Timer(longest, child.kill)
    late.start()
    try:
        report, failure = _child_result(child, asked)
    finally:
        late.cancel()
    if failure:
        raise RuntimeFault(f"preflight: {failure}")
    return report


def _supervise(flight: PreflightRun, request: Mapping[str, Any]) -> None:
    """Wait for the child and store its result; whatever happens, the preflight is over afterwards."""
    report: dict[str, Any] = {}
    failure: str = _UNREADABLE
    try:
        report, failure = _child_result(flight.child, request)
    finally:
        if not flight.failure:
            flight.finished, flight.failure = report, failure
        flight.over.set()


def _child_result(child: subprocess.Popen[bytes], request: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    """Wait until the child has ended; return its report, and the reason if there is none."""
    assert child.stdin is not None
    assert child.stdout is not None
    with contextlib.suppress(BrokenPipeError):  # it ended without reading; the exit code is reported below
        child.stdin.write(json.dumps(request).encode() + b"\n")
        child.stdin.flush()
    output = child.stdout.read()  # communicate() would close its standard input, which ends it
    code = child.wait()
    child.stdout.close()
    with contextlib.suppress(BrokenPipeError):  # likewise, for bytes that were still buffered
        child.stdin.close()
    report = _report(output)
    return report, "" if report else _SAID_NOTHING(code=code)


def _report(output: bytes) -> dict[str, Any]:
    try:
        fields = json.loads(output)
    except ValueError:
        return {}
    return dict(fields) if isinstance(fields, Mapping) else {}


def default_deadline(settings: Deployment) -> float:
    """Return the default time for a preflight [s]: the sum of the policy's own deadlines and a reserve."""
    policy = settings.policy.model_dump()
    return (
        _ROOM_S + _deadlines(policy) + float(policy.get("inference_deadline", 0.0))
    )  # there are two requests


def _deadlines(table: Mapping[str, Any]) -> float:
    """Return the sum of all deadlines in a table and its nested tables, for example that of a tunnel [s]."""
    own = [float(value) for key, value in table.items() if key.endswith("_deadline") and value is not None]
    return sum(own) + sum(_deadlines(value) for value in table.values() if isinstance(value, Mapping))
