"""The scripts behind the channel: each a holder of its own, which is alive as long as it speaks."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from runtime.clients.client import Refused, StationClient
from runtime.core.errors import TransportError


@dataclass(slots=True)
class ScriptSelection:
    """The choices of one script; what is None or empty was not chosen, and the deployment's own holds."""

    task: str | None = None
    collect_task: str | None = None
    strategy: dict[str, Any] = field(default_factory=dict)
    mode: str | None = None
    target: list[float] | None = None  # joints [D] of `manual_qpos`

    def choose(self, **chosen: Any) -> None:
        """Remember; a strategy adds to the one that was chosen before."""
        for name, value in chosen.items():
            setattr(self, name, self.strategy | value if name == "strategy" else value)

    @property
    def setup(self) -> dict[str, Any]:
        """The arguments of a set-up with these choices."""
        wanted = {"task": self.task, "strategy": self.strategy or None}
        return {name: value for name, value in wanted.items() if value is not None}

    @property
    def run(self) -> dict[str, Any]:
        """The arguments of a run with these choices."""
        return {} if self.mode is None else {"mode": self.mode}


KEPT = 200  # scripts of one connection each, of which the oldest are forgotten


@dataclass(slots=True)
class Script:
    """One script: the client that commands for it, what it has chosen, whether it has the lease."""

    client: StationClient
    selection: ScriptSelection = field(default_factory=ScriptSelection)
    holds: bool = False

    def claim(self) -> None:
        """Claim the lease, or renew it; raises Refused where another has it."""
        try:
            self.client.claim()
        except Refused:
            self.holds = False
            raise
        self.holds = True

    def release(self) -> None:
        """Give the lease back, where it has it."""
        if self.holds:
            self.holds = False
            self.client.release()

    def mark_lease_lost(self) -> None:
        """Its lease is over."""
        self.holds = False

    def close(self) -> None:
        self.client.close()


class ScriptActivity:
    """When each script was last heard; told by one thread, asked by another."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._heard: dict[str, float] = {}
        self._lock = threading.Lock()

    def record(self, holder: str) -> None:
        """It has just spoken."""
        with self._lock:
            self._heard.pop(holder, None)
            self._heard[holder] = self._now()
            if len(self._heard) > KEPT:
                del self._heard[next(iter(self._heard))]

    def silence(self, holder: str) -> float:
        """For how long it has said nothing [s]."""
        with self._lock:
            return self._now() - self._heard.get(holder, -float("inf"))

    def is_known(self, holder: str) -> bool:
        """True if it is one of the channel's scripts."""
        with self._lock:
            return holder in self._heard


class Scripts:
    """By the name of the holder; used by one thread, whose sockets their clients are."""

    def __init__(
        self, open_client: Callable[[str], StationClient], lives: ScriptActivity, silence_s: float
    ) -> None:
        self._open, self._lives, self._silence = open_client, lives, silence_s
        self._known: dict[str, Script] = {}

    def get_or_create(self, holder: str) -> Script:
        """The script, made where it is new."""
        script = self._known.pop(holder, None) or Script(self._open(holder))
        self._known[holder] = script
        for name in [name for name, other in self._known.items() if not other.holds][:-KEPT]:
            self._known.pop(name).close()
        return script

    def poll(self) -> list[str]:
        """Renew the leases of those who speak, end those of the silent; returns a sentence for each that ended."""
        told = []
        for holder, script in self._known.items():
            if not script.holds:
                continue
            silence = self._lives.silence(holder)
            try:
                if silence <= self._silence:
                    script.client.renew()
                    continue
                script.client.release()
                told.append(f"{holder} has said nothing for {silence:.1f} s: its lease is over")
            except TransportError as fault:  # a station that is away has no lease either, in a while
                if silence <= self._silence:
                    continue
                told.append(f"{holder}: {fault}")
            except Refused as refusal:
                told.append(f"{holder} has the lease no longer: {refusal}")
            script.mark_lease_lost()
        return told

    def close(self) -> None:
        """Close their clients; leases that are held end by themselves."""
        for script in self._known.values():
            script.close()
