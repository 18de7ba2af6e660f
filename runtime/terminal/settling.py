"""Waits until what was asked of an open run is over, so that a script can ask for the next thing."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from runtime.client import StationClient

BUSY = ("asking", "executing", "moving", "approaching", "starved")
_CALM_TICKS = 3  # an order reaches control, and its answer us, within that many
_LOOK_S = 0.02
_FAILURES = ("chunk_dropped", "policy_failed", "policy_lost")


@dataclass(frozen=True, slots=True)
class Settled:
    """The status when all was over, and the events until then."""

    status: dict[str, Any]
    events: list[dict[str, Any]]

    def failure(self, wants: str = "") -> str:
        """Why it did not go well, "" where it did; `wants` is the kind of the event that belongs to it."""
        if self.status["state"] != "running":
            return f"the run does not go on: {self.status['state']}, {self.status['reason']}"
        failed = [str(event["text"]) for event in self.events if event["kind"] in _FAILURES]
        if failed:
            return failed[-1]
        if wants and not any(event["kind"] == wants for event in self.events):
            return f"it was ended before its end ({wants} was not told)"
        return ""


def settle(client: StationClient, newest_event: int, tell: Callable[[dict[str, Any]], None]) -> Settled:
    """Stay until the run waits again or does not go on; events after `newest_event` are told as they come."""
    events: list[dict[str, Any]] = []
    calm_since = None
    while True:
        status = client.status()
        if status["newest_event"] > newest_event:
            for event in client.events_since(newest_event):
                newest_event = event["number"]
                events.append(event)
                tell(event)
        step = status["control"]["step"]
        if status["phase"] in BUSY or calm_since is None:
            calm_since = step
        if status["state"] != "running" or step - calm_since >= _CALM_TICKS:
            return Settled(status, events)
        client.renew()
        time.sleep(_LOOK_S)
