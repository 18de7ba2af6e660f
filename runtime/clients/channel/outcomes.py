"""Outcomes of commands that go on after they were accepted: looked at until they are over."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from runtime.clients.terminal.wait_settled import CALM_TICKS, Settled, is_busy

KEPT = 1000
# What the session is while each goes on; the rest goes on within the state it was given in.
_WHILE = {"setup": "preparing", "home": "preparing", "run": "going", "resume": "going"}
_WITHIN = {
    "step": "",
    "commit": "",
    "cancel": "",
    "gripper": "",
    "move": "motion_done",
}  # and the event they want
Events = Callable[[int], list[dict[str, Any]]]


def is_long_running(kind: str) -> bool:
    """True if a command goes on after it was accepted."""
    return kind in _WHILE or kind in _WITHIN or kind == "approach"


@dataclass(slots=True)
class Outcome:
    """One command: "accepted", "refused" or "unknown", and from "accepted" on "done" or "failed".

    `said` is the word of the script, `kind` the command of ours that it came to.
    """

    id: str
    said: str
    kind: str
    result: str
    reason: str = ""
    before: Mapping[str, Any] = field(default_factory=dict)  # the status when it was given
    events: list[dict[str, Any]] = field(default_factory=list)  # since then
    looked_since: int | None = None  # the step of the first look
    calm_since: int | None = None

    @property
    def to_dict(self) -> dict[str, Any]:
        return {"id": self.id, "said": self.said, "result": self.result, "reason": self.reason}

    def resolve(self, result: str, reason: str) -> None:
        """The command came to `result`, for that reason."""
        self.result, self.reason = result, reason

    def explain(self, reason: str) -> None:
        """What is to be said of it besides."""
        self.reason = reason

    def accept(self, kind: str, before: Mapping[str, Any]) -> None:
        """The station took the command `kind`; `before` was its status where that goes on, {} where it is done."""
        self.kind, self.result, self.before = kind, "accepted" if before else "done", before

    def poll(self, status: dict[str, Any], events_since: Events) -> None:
        """See whether it is over."""
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
        """True if it was seen to stand twice, so far apart that what there is to tell of it was told.

        What is seen in the first ticks says nothing: it may not have begun.
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
        heard = self.events[-1]["number"] if self.events else self.before["newest_event"]
        if status["newest_event"] > heard:
            self.events.extend(events_since(heard))

    def _end(self, result: str, reason: str) -> None:
        self.result, self.reason, self.before, self.events = result, reason, {}, []


class Outcomes:
    """The newest outcomes by id; of several threads."""

    def __init__(self) -> None:
        self._kept: dict[str, Outcome] = {}
        self._lock = threading.Lock()

    def add(self, outcome: Outcome) -> None:
        """Remember it; what is known of an id is not replaced."""
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
        """Those that go on."""
        with self._lock:
            return [outcome for outcome in self._kept.values() if outcome.result == "accepted"]
