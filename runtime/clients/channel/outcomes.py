"""Outcomes of commands that continue after they were accepted.

The station is polled for the outcome of such a command until the command has ended.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from runtime.clients.terminal.wait_settled import CALM_TICKS, Settled, is_busy

KEPT = 1000
# Condition of the session while each command runs; all others run within the state in which they were sent.
_WHILE = {"setup": "preparing", "home": "preparing", "run": "going", "resume": "going"}
_WITHIN = {
    "step": "",
    "commit": "",
    "cancel": "",
    "gripper": "",
    "move": "motion_done",
}  # event that completes each; "" if none
Events = Callable[[int], list[dict[str, Any]]]


def is_long_running(kind: str) -> bool:
    """Return True if a command continues after it was accepted."""
    return kind in _WHILE or kind in _WITHIN or kind == "approach"


@dataclass(slots=True)
class Outcome:
    """Outcome of one command: "accepted", "refused", "unknown", "done" or "failed".

    Only "accepted" changes later: to "done" or "failed", or to "unknown" if the station restarts. `said` is the name in
    the script's message, `kind` the command of EVA Web that this name stands for.
    """

    id: str
    said: str
    kind: str
    result: str
    reason: str = ""
    before: Mapping[str, Any] = field(default_factory=dict)  # status before the command
    events: list[dict[str, Any]] = field(default_factory=list)  # events after the command
    looked_since: int | None = None  # control step at the first poll
    calm_since: int | None = None

    @property
    def to_dict(self) -> dict[str, Any]:
        return {"id": self.id, "said": self.said, "result": self.result, "reason": self.reason}

    def resolve(self, result: str, reason: str) -> None:
        """Set the result and its reason."""
        self.result, self.reason = result, reason

    def explain(self, reason: str) -> None:
        """Set the reason, without changing the result."""
        self.reason = reason

    def accept(self, kind: str, before: Mapping[str, Any]) -> None:
        """Record that the station accepted the command `kind`.

        For a long-running command, `before` is the status of the station before the command. For any other command it
        is {}, and the command counts as done already.
        """
        self.kind, self.result, self.before = kind, "accepted" if before else "done", before

    def poll(self, status: dict[str, Any], events_since: Events) -> None:
        """Update the outcome from the station's status. Call regularly until it is no longer "accepted"."""
        if status["boot"] != self.before["boot"]:
            self._end("unknown", "the station was restarted")
            return
        during = _WHILE.get(self.kind)
        if self.kind == "approach" and not self.before["state_is"]["run_open"]:
            during = "preparing"
        if during is None:
            self._settle(status, events_since)
        elif status["state_is"]["ready"]:
            self._end("done", status["reason"])
        elif not status["state_is"][during]:
            self._end("failed", f"{status['state']}: {status['reason']}")

    def _settle(self, status: dict[str, Any], events_since: Events) -> None:
        self._read_events(status, events_since)
        if status["state"] == self.before["state"] and not self._is_settled(status):
            return
        wants = "motion_done" if self.kind == "approach" else _WITHIN[self.kind]
        failure = Settled(self.before["state"], status, self.events).failure(wants)
        self._end("failed" if failure else "done", failure)

    def _is_settled(self, status: dict[str, Any]) -> bool:
        """Return True if the station was at rest in two polls at least CALM_TICKS apart: its events are then complete.

        Polls in the first CALM_TICKS do not count, because the command may not have begun.
        """
        step = status["control"]["step"]
        if self.looked_since is None:
            self.looked_since = step
        if is_busy(status) or step - self.looked_since < CALM_TICKS:
            self.calm_since = None
        elif self.calm_since is None:
            self.calm_since = step
        return self.calm_since is not None and step - self.calm_since >= CALM_TICKS

    def _read_events(self, status: dict[str, Any], events_since: Events) -> None:
        newest = self.events[-1]["number"] if self.events else self.before["newest_event"]
        if status["newest_event"] > newest:
            self.events.extend(events_since(newest))

    def _end(self, result: str, reason: str) -> None:
        self.result, self.reason, self.before, self.events = result, reason, {}, []


class Outcomes:
    """Newest outcomes by id; thread-safe."""

    def __init__(self) -> None:
        self._kept: dict[str, Outcome] = {}
        self._lock = threading.Lock()

    def add(self, outcome: Outcome) -> None:
        """Store an outcome; only an "unknown" outcome of the same id is replaced."""
        with self._lock:
            first = self._kept.get(outcome.id)
            if first is None or first.result == "unknown":
                self._kept[outcome.id] = outcome
            if len(self._kept) > KEPT:
                del self._kept[next(iter(self._kept))]

    def get(self, identity: str) -> Outcome | None:
        with self._lock:
            return self._kept.get(identity)

    @property
    def pending(self) -> list[Outcome]:
        """Outcomes of commands that were accepted and are not over yet."""
        with self._lock:
            return [outcome for outcome in self._kept.values() if outcome.result == "accepted"]
