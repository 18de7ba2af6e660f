"""Links of each process of a station to the others."""

from __future__ import annotations

from dataclasses import dataclass

from runtime.ipc.lifeline import Lifeline
from runtime.ipc.shared_state import SharedState

# [s] how long guard and reception stay after control's own end: to the last it can see, and be stopped
_OUTLIVES_S = 1.0
_REST_S = 0.1


def rest_s(heartbeat_timeout: float) -> float:
    """How long a process sleeps that nobody wakes [s]: others count the seconds since it last said that it lives."""
    return min(_REST_S, heartbeat_timeout / 10.0)


@dataclass(frozen=True, slots=True)
class Membership:
    """The shared state, the name of this start of the station, and the lifeline to its supervisor."""

    shared: SharedState
    boot: str
    lifeline: Lifeline

    def is_needed(self, now: float) -> bool:
        """True while a process that outlives control is needed: until then the supervisor may be gone."""
        return not self.lifeline.is_cut or self.shared.alive("control", now, _OUTLIVES_S)
