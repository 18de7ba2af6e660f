"""Scripts behind the channel: each holds a lease of its own, which lasts while the script sends messages."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from runtime.clients.client import Refused, StationClient
from runtime.core.errors import TransportError


@dataclass(slots=True)
class ScriptSelection:
    """Values that one script has chosen for set-ups and runs. If a value is None or empty, the deployment's applies."""

    task: str | None = None
    collect_task: str | None = None
    strategy: dict[str, Any] = field(default_factory=dict)
    mode: str | None = None
    target: list[float] | None = None  # joints [D] of `manual_qpos`

    def choose(self, **chosen: Any) -> None:
        """Record choices; strategy parameters are added to the parameters chosen before."""
        for name, value in chosen.items():
            setattr(self, name, self.strategy | value if name == "strategy" else value)

    @property
    def setup(self) -> dict[str, Any]:
        """Arguments of a set-up with these choices."""
        selected = {"task": self.task, "strategy": self.strategy or None}
        return {name: value for name, value in selected.items() if value is not None}

    @property
    def run(self) -> dict[str, Any]:
        """Arguments of a run with these choices."""
        return {} if self.mode is None else {"mode": self.mode}


KEPT = 200  # greatest number of scripts remembered; the oldest are dropped


@dataclass(slots=True)
class Script:
    """Script behind the channel: its client, its choices, and whether it holds the lease."""

    client: StationClient
    selection: ScriptSelection = field(default_factory=ScriptSelection)
    holds: bool = False

    def claim(self) -> None:
        """Claim or renew the lease. Raises: Refused if another holder has it."""
        try:
            self.client.claim()
        except Refused:
            self.holds = False
            raise
        self.holds = True

    def release(self) -> None:
        """Release the lease if the script holds it."""
        if self.holds:
            self.holds = False
            self.client.release()

    def mark_lease_lost(self) -> None:
        """Record that the lease has ended."""
        self.holds = False

    def close(self) -> None:
        self.client.close()


class ScriptActivity:
    """Time of each script's last message; written by one thread, read by another."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._heard: dict[str, float] = {}
        self._lock = threading.Lock()

    def record(self, holder: str) -> None:
        """Record a message of that holder now."""
        with self._lock:
            self._heard.pop(holder, None)
            self._heard[holder] = self._now()
            if len(self._heard) > KEPT:
                del self._heard[next(iter(self._heard))]

    def silence(self, holder: str) -> float:
        """Return the time since the holder's last message [s]; infinite if there was none."""
        with self._lock:
            return self._now() - self._heard.get(holder, -float("inf"))

    def is_known(self, holder: str) -> bool:
        """Return True if the holder is one of the channel's scripts."""
        with self._lock:
            return holder in self._heard


class Scripts:
    """Scripts by the name of their holder. One thread uses it, because it owns the sockets of their clients."""

    def __init__(
        self, open_client: Callable[[str], StationClient], lives: ScriptActivity, silence_s: float
    ) -> None:
        self._open, self._lives, self._silence = open_client, lives, silence_s
        self._known: dict[str, Script] = {}

    def get_or_create(self, holder: str) -> Script:
        """Return the script of that holder; create it if it is new."""
        script = self._known.pop(holder, None) or Script(self._open(holder))
        self._known[holder] = script
        for name in [name for name, cached in self._known.items() if not cached.holds][:-KEPT]:
            self._known.pop(name).close()
        return script

    def poll(self) -> list[str]:
        """Renew leases of active scripts, end those of silent scripts; return a sentence for each that ended."""
        texts = []
        for holder, script in self._known.items():
            if not script.holds:
                continue
            silence = self._lives.silence(holder)
            try:
                if silence <= self._silence:
                    script.client.renew()
                    continue
                script.client.release()
                texts.append(f"{holder}: no message for {silence:.1f} s; its lease has ended")
            except TransportError as fault:  # the lease of an unreachable station expires by itself
                if silence <= self._silence:
                    continue
                texts.append(f"{holder}: {fault}")
            except Refused as refusal:
                texts.append(f"{holder} has the lease no longer: {refusal}")
            script.mark_lease_lost()
        return texts

    def close(self) -> None:
        """Close all clients; leases still held expire by themselves."""
        for script in self._known.values():
            script.close()
