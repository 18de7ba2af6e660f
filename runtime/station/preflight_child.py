"""Preflights in processes of their own: nothing that one meets can delay or end whoever wants it."""

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
_SAID_NOTHING = Pattern("preflight.said_nothing", "its process ended with {code} and said nothing")

_ROOM_S = 10.0  # beside the deadlines of the policy's own calls: kinematics, a slow machine
_GRACE_S = 180.0  # beyond the deadline, for a process that may have kinematics to compile
_KEPT = 20  # reports, of which the oldest is forgotten first
Spawn = Callable[[], "subprocess.Popen[bytes]"]


@dataclass(slots=True)
class PreflightRun:
    """One preflight: under way as long as `told` is empty, then a report, or a `failure` without one."""

    id: str
    about: str
    child: subprocess.Popen[bytes]
    ends: float  # on time.monotonic, when it is killed
    finished: dict[str, Any] = field(default_factory=dict)
    failure: str = ""
    over: threading.Event = field(default_factory=threading.Event)

    def end(self, why: str) -> None:
        """Kill it; `why` is what is said instead of a report."""
        self.failure = why
        self.child.kill()

    def to_dict(self) -> dict[str, Any]:
        """As an answer: `running`, `report` or null, and why there is none."""
        return {"running": not self.over.is_set(), "report": self.finished or None, "failure": self.failure}


class Preflights:
    """One at a time; `look` is cheap, and returns each that has ended once. Not for several threads."""

    def __init__(self, spawn: Spawn | None = None, now: Callable[[], float] = time.monotonic) -> None:
        self._spawn = spawn or _spawn_child
        self._now = now
        self._flight: PreflightRun | None = None
        self._kept: dict[str, PreflightRun] = {}

    @property
    def current(self) -> str:
        """Name of what is being looked at, "" where nothing is."""
        return self._flight.about if self._flight else ""

    def start(self, asked: PreflightRequest, resolved: Resolved) -> float:
        """Begin; after how many seconds it is over at the latest, compiling included.

        RuntimeFault where another is under way, or its process cannot be started.

        What is asked for is not checked here: that it is no valid deployment is what the report says.
        """
        if asked.id in self._kept:  # asked again: the answer to the first one was lost
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
        """The one that has ended since the last look; ends one whose time is over."""
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
        """End what is under way, if anything is."""
        if self._flight is not None and not self._flight.failure:
            self._flight.end(_CANCELLED(why=why))

    def report(self, id: str) -> dict[str, Any]:
        """The preflight of that id, as by `PreflightRun.to_dict`; RuntimeFault where it is not known (any more)."""
        if id not in self._kept:
            raise RuntimeFault(_UNKNOWN(identity=id, kept=_KEPT))
        return self._kept[id].to_dict()

    def close(self) -> None:
        """End what is under way, and wait for it."""
        flight = self._flight
        if flight is not None:
            self.cancel(_STATION_ENDS)
            flight.over.wait(2.0)


def _deadline_for(resolved: Resolved, asked: PreflightRequest) -> float:
    """Sum of the policy's own deadlines [s]; where it is no deployment, its process says so at once."""
    try:
        return default_deadline(apply_changes(resolved, asked.changes, "preflight").deployment)
    except RuntimeFault:
        return 30.0


def _spawn_child() -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "runtime.preflight", "--given"],
        stdin=subprocess.PIPE,  # its end is ours
        stdout=subprocess.PIPE,
        env=without_web_secrets(os.environ),  # a worker's has the web's
    )


def run_preflight(asked: Mapping[str, Any], longest: float) -> dict[str, Any]:
    """The report about what is asked as by `python -m runtime.preflight --given`; waits for it at most so long [s].

    RuntimeFault where its process ends without one.
    """
    child = _spawn_child()
    late = threading.Timer(longest, child.kill)
    late.start()
    try:
        report, failure = _told(child, asked)
    finally:
        late.cancel()
    if failure:
        raise RuntimeFault(f"preflight: {failure}")
    return report


def _supervise(flight: PreflightRun, asked: Mapping[str, Any]) -> None:
    """Whatever becomes of the child, the flight is over at its end."""
    report: dict[str, Any] = {}
    failure: str = _UNREADABLE
    try:
        report, failure = _told(flight.child, asked)
    finally:
        if not flight.failure:
            flight.finished, flight.failure = report, failure
        flight.over.set()


def _told(child: subprocess.Popen[bytes], asked: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    """The report of the child, and why there is none; returns when it has ended."""
    assert child.stdin is not None
    assert child.stdout is not None
    with contextlib.suppress(BrokenPipeError):  # it has ended without listening; its code says so below
        child.stdin.write(json.dumps(asked).encode() + b"\n")
        child.stdin.flush()
    said = child.stdout.read()  # not communicate(), which would close its standard input
    code = child.wait()
    child.stdout.close()
    with contextlib.suppress(BrokenPipeError):  # the same once more, for what was still in its buffer
        child.stdin.close()
    report = _report(said)
    return report, "" if report else _SAID_NOTHING(code=code)


def _report(said: bytes) -> dict[str, Any]:
    try:
        found = json.loads(said)
    except ValueError:
        return {}
    return dict(found) if isinstance(found, Mapping) else {}


def default_deadline(settings: Deployment) -> float:
    """Time that a preflight may take where none is given [s]: what the policy's own deadlines come to."""
    policy = settings.policy.model_dump()
    return _ROOM_S + _deadlines(policy) + float(policy.get("inference_deadline", 0.0))  # it is asked twice


def _deadlines(table: Mapping[str, Any]) -> float:
    """The sum of all deadlines in a table and in those within it, such as that of a tunnel."""
    own = [float(value) for key, value in table.items() if key.endswith("_deadline") and value is not None]
    return sum(own) + sum(_deadlines(value) for value in table.values() if isinstance(value, Mapping))
