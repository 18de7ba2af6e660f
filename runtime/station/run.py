"""A run: from the moment it is asked for until its episode is on disk."""

from __future__ import annotations

import math
import platform
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any

from runtime.core.git_revision import revision
from runtime.ipc.messages import Mode
from runtime.policies.base import PolicyInfo
from runtime.station.spec import StationSpec

_COUNTS = ("ticks", "missed", "records_lost")
_PACKAGES = ("eva-web", "numpy", "pyarrow", "av", "pyzmq", "msgpack")


def installed_versions() -> dict[str, str]:
    """Of Python, of us, and of what decides how a run comes out or how it is written down."""
    return {"python": platform.python_version()} | {package: version(package) for package in _PACKAGES}


@dataclass(slots=True)
class Run:
    """One open run; times on our monotonic clock [s]."""

    number: int
    uuid: str
    requested: float
    duration_s: float | None = None  # after which it ends by itself
    mode: Mode = "continuous"
    trial: bool = False  # it is one of a trial
    is_approaching: bool = False  # a motion to the chunk that is shown
    begun_at: float | None = None  # control follows
    followed_at: float = -math.inf  # since when it does, without a hold between
    held_since: float | None = None
    held: float = 0.0  # in total
    command: str = ""  # uuid of the command that asked for it
    opened: bool = False  # media is ready for it
    unopened: bool = False  # its recording could not be opened: there is none, and it never began
    waiting: bool = False  # begins when what it needs is loaded
    unrecorded: str = ""  # why its recording ended before it did
    counted: Mapping[str, Any] = field(default_factory=dict)  # control's figures when it was asked for
    reached: dict[str, float] = field(default_factory=dict)  # milestones of a simulated bench [s of the run]

    def figures(self, now: Mapping[str, Any]) -> dict[str, Any]:
        """Control's figures `now`, with what it counts counted from the beginning of this run.

        A control that was restarted meanwhile counts from its own beginning.
        """
        since = {key: now[key] - self.counted.get(key, 0) for key in _COUNTS}
        return {**now, **({} if min(since.values()) < 0 else since)}

    @property
    def never_began_data(self) -> dict[str, Any]:
        """Data for the client of a run that ended before control followed; {} where it began."""
        if self.begun_at is not None:
            return {}
        return {"unbegun": {"command": self.command, "episode": self.uuid, "unopened": self.unopened}}

    def open(self) -> None:
        """Media is ready for it."""
        self.opened = True

    def fail_to_open(self) -> None:
        """Its recording could not be opened, and it must not begin without one."""
        self.unopened = True

    def stop_recording(self, why: str) -> None:
        """It goes on without its recording, which could not be opened or has ended."""
        self.unrecorded = why

    def wait(self) -> None:
        """It begins when what it needs is loaded."""
        self.waiting = True

    def approach(self) -> None:
        """The robot goes to where the chunk that is shown begins."""
        self.is_approaching = True

    def arrive(self) -> None:
        """The robot is there, or does something else."""
        self.is_approaching = False

    def begin(self, now: float) -> None:
        """Control follows: its clock starts."""
        self.waiting = False
        self.begun_at, self.held_since, self.held = now, None, 0.0
        self.followed_at = now

    def hold(self, now: float) -> None:
        """Its clock is paused; one that waits begins when it is resumed."""
        self.waiting = False
        if self.held_since is None:
            self.held_since = now

    def resume(self, now: float) -> None:
        """Its clock goes on."""
        if self.held_since is not None:
            self.held += now - self.held_since
            self.held_since = None
            self.followed_at = now

    def elapsed(self, now: float) -> float:
        """Time it has run, without the time it was held."""
        if self.begun_at is None:
            return 0.0
        return (now if self.held_since is None else self.held_since) - self.begun_at - self.held

    def status(self, now: float) -> dict[str, Any]:
        """Which run it is, how long it has run and been held [s], and its limit."""
        held = self.held + (now - self.held_since if self.held_since is not None else 0.0)
        return {
            "number": self.number,
            "uuid": self.uuid,
            "elapsed": self.elapsed(now),
            "held": held,
            "duration_s": self.duration_s,
        }


@dataclass(frozen=True, slots=True)
class Provenance:
    """Entries of every manifest about the station as last set up; `spec` is the one in force since then."""

    spec: StationSpec
    boot: str
    checkpoint: Mapping[str, Any] = field(
        default_factory=dict
    )  # as the one who asked for the set-up named it
    bench: Mapping[str, Any] = field(default_factory=dict)  # how a simulated one was asked to be laid out
    versions: dict[str, str] = field(default_factory=installed_versions)
    git: Mapping[str, Any] = field(default_factory=revision)  # {} where the runtime runs from no checkout

    def manifest(self, mode: str, info: PolicyInfo | None, sim_state: str = "") -> dict[str, Any]:
        """The manifest of a new episode, without what only media knows; `sim_state` where the mode is sim."""
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
            "git": dict(self.git),
            "asked_wall": time.time(),
        }
