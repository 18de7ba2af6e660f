"""Membership of a process in its station: shared state, boot id and lifeline."""

from __future__ import annotations

from dataclasses import dataclass

from runtime.ipc.lifeline import Lifeline
from runtime.ipc.shared_state import SharedState

# [s] by which guard and reception outlive control: until its end it can receive joints and be stopped
_OUTLIVES_S = 1.0
_REST_S = 0.1


def rest_s(heartbeat_timeout: float) -> float:
    """Return for how long a process without a bell may sleep at a time [s].

    It is short enough for the heartbeats of the process.
    """
    return min(_REST_S, heartbeat_timeout / 10.0)


@dataclass(frozen=True, slots=True)
class Membership:
    """Shared state, boot id (the name of this start of the station), and lifeline to the supervisor."""

    shared: SharedState
    boot: str
    lifeline: Lifeline

    def is_needed(self, now: float) -> bool:
        """Return True while the supervisor lives or control still ticks.

        It is for processes that control needs until control itself ends.
        """
        return not self.lifeline.is_cut or self.shared.alive("control", now, _OUTLIVES_S)
