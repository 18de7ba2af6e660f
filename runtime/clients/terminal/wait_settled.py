"""Wait for the end of a command, so that a script can send the next."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from runtime.clients.client import StationClient

_BUSY = ("asking", "executing", "moving", "approaching", "starved")
CALM_TICKS = 3  # ticks within which an order reaches control and its effect reaches the status
_LOOK_S = 0.02
_FAILURES = ("chunk_dropped", "policy_failed", "policy_lost")


@dataclass(frozen=True, slots=True)
class Settled:
    """End of a command: the state in which it was sent, the status when it was over, and the events in between."""

    began: str
    status: dict[str, Any]
    events: list[dict[str, Any]]

    def failure(self, wants: str = "") -> str:
        """Return the reason why the command failed, "" if it did not.

        `wants` is the kind of an event that must have occurred, "" for none.
        """
        if self.status["state"] != self.began:
            return f"{self.began} no longer: {self.status['state']}, {self.status['reason']}"
        failed = [str(event["text"]) for event in self.events if event["kind"] in _FAILURES]
        if failed:
            return failed[-1]
        if wants and not any(event["kind"] == wants for event in self.events):
            return f"it ended early ({wants} was not reported)"
        return ""


def wait_until_settled(
    client: StationClient, before: dict[str, Any], tell: Callable[[dict[str, Any]], None]
) -> Settled:
    """Wait until nothing moves and no request is pending, or the state differs from the state in `before`.

    The lease is renewed meanwhile; events since the status `before` are passed to `tell`.
    """
    began, newest_event = before["state"], before["newest_event"]
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
        if is_busy(status):
            calm_since = None
        elif calm_since is None:
            calm_since = step
        calm = calm_since is not None and step - calm_since >= CALM_TICKS
        if status["state"] != began or calm:
            return Settled(began, status, events)
        client.renew()
        time.sleep(_LOOK_S)


def is_busy(status: dict[str, Any]) -> bool:
    """Return True if a run is in an active phase or a motion is in progress.

    The motion counts separately, because a gripper can move without an open run.
    """
    return status["phase"] in _BUSY or status["control"]["behaviour"] == "motion"
