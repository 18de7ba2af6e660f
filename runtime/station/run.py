"""State of a run, from its request until its episode is on disk."""

from __future__ import annotations

import math
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from runtime.benches.environments import describe_program
from runtime.core.git_revision import revision
from runtime.core.machine import installed_versions, processor
from runtime.ipc.messages import Mode
from runtime.policies.base import PolicyInfo
from runtime.station.spec import StationSpec

_COUNTS = ("ticks", "missed", "records_lost")


@dataclass(slots=True)
class Run:
    """Open run; times on our monotonic clock [s]."""

    number: int
    uuid: str
    requested: float
    duration_s: float | None = None  # [s] after which it ends by itself
    mode: Mode = "continuous"
    trial: bool = False  # part of a trial
    is_approaching: bool = False  # moving to the start of the proposal
    begun_at: float | None = None  # control follows since then
    followed_at: float = -math.inf  # since when control follows without a hold
    held_since: float | None = None
    held: float = 0.0  # total time on hold [s]
    command: str = ""  # uuid of the command that requested it
    opened: bool = False  # media is ready
    unopened: bool = False  # its recording could not be opened, so it never began
    waiting: bool = False  # begins when everything that it needs is loaded
    unrecorded: str = ""  # reason why its recording ended early
    counted: Mapping[str, Any] = field(default_factory=dict)  # control's counters when it was requested
    reached: dict[str, float] = field(default_factory=dict)  # milestones of a simulated bench [s of the run]

    def figures(self, now: Mapping[str, Any]) -> dict[str, Any]:
        """Return control's figures at `now`, with its counters relative to the start of this run.

        If control was restarted meanwhile, they are relative to that restart.
        """
        since = {key: now[key] - self.counted.get(key, 0) for key in _COUNTS}
        return {**now, **({} if min(since.values()) < 0 else since)}

    @property
    def never_began_data(self) -> dict[str, Any]:
        """Data for the client about a run that ended before control followed it; {} for a run that began."""
        if self.begun_at is not None:
            return {}
        return {"unbegun": {"command": self.command, "episode": self.uuid, "unopened": self.unopened}}

    def open(self) -> None:
        """Record that media is ready."""
        self.opened = True

    def fail_to_open(self) -> None:
        """Record that the run's recording could not be opened, so that the run must not begin."""
        self.unopened = True

    def stop_recording(self, why: str) -> None:
        """Record that the run continues without its recording, which could not be opened or has ended."""
        self.unrecorded = why

    def wait(self) -> None:
        """Record that the run begins later, when everything that it needs is loaded."""
        self.waiting = True

    def approach(self) -> None:
        """Record that the robot moves to the start of the proposal."""
        self.is_approaching = True

    def arrive(self) -> None:
        """Record that the motion to the start of the proposal has ended."""
        self.is_approaching = False

    def begin(self, now: float) -> None:
        """Start the run's clock, because control follows the run from now on."""
        self.waiting = False
        self.begun_at, self.held_since, self.held = now, None, 0.0
        self.followed_at = now

    def hold(self, now: float) -> None:
        """Pause the run's clock; a run that still waits begins when it is resumed."""
        self.waiting = False
        if self.held_since is None:
            self.held_since = now

    def resume(self, now: float) -> None:
        """Continue the run's clock."""
        if self.held_since is not None:
            self.held += now - self.held_since
            self.held_since = None
            self.followed_at = now

    def elapsed(self, now: float) -> float:
        """Return for how long the run has been executed [s], without holds."""
        if self.begun_at is None:
            return 0.0
        return (now if self.held_since is None else self.held_since) - self.begun_at - self.held

    def status(self, now: float) -> dict[str, Any]:
        """Return the run's number, uuid, executed and held time [s], and its limit [s]."""
        held_s = self.held + (now - self.held_since if self.held_since is not None else 0.0)
        return {
            "number": self.number,
            "uuid": self.uuid,
            "elapsed": self.elapsed(now),
            "held": held_s,
            "duration_s": self.duration_s,
        }


@dataclass(frozen=True, slots=True)
class Provenance:
    """Entries about the station that every manifest has.

    `spec` is the specification of the last set-up.
    """

    spec: StationSpec
    boot: str
    checkpoint: Mapping[str, Any] = field(default_factory=dict)  # as named in the request of the set-up
    bench: Mapping[str, Any] = field(default_factory=dict)  # requested layout of a simulated bench
    versions: dict[str, str] = field(default_factory=installed_versions)
    git: Mapping[str, Any] = field(default_factory=revision)  # {} without a git checkout

    def manifest(self, mode: str, info: PolicyInfo | None, sim_state: str = "") -> dict[str, Any]:
        """Return the manifest of a new episode, without the entries of media.

        `sim_state` is used in mode "sim" only.
        """
        settings = self.spec.deployment
        return {
            "uuid": str(uuid.uuid4()),
            "station": settings.station,
            "boot": self.boot,
            "task": settings.task,
            "operator": settings.operator,
            "trial": {},
            "checkpoint": dict(self.checkpoint),
            "bench": dict(self.bench),
            "duration_s": None,
            "kind": settings.recording.kind,
            "mode": mode,
            **({"sim_state": sim_state} if mode == "sim" else {}),
            "strategy": settings.strategy.kind,
            "policy": {"kind": settings.policy.kind, "name": info.name, "metadata": dict(info.metadata)}
            if info
            else {"kind": settings.policy.kind},
            "configuration": dict(self.spec.resolved.tree),
            "configuration_hash": self.spec.resolved.digest,
            "versions": self.versions,
            "processor": processor(),
            **describe_program(self.spec.capabilities.bench),
            "git": dict(self.git),
            "asked_wall": time.time(),
        }
