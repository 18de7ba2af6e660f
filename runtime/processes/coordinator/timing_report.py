"""Events about control's timing: real time is not permitted, or ticks are late. Each is emitted once, not per tick."""

from __future__ import annotations

from runtime.core import realtime
from runtime.core.sentences import Pattern
from runtime.ipc.messages import Event
from runtime.ipc.shared_state import SharedState

_LATE = Pattern("timing.late", "one tick in a hundred begins more than {ms:.1f} ms late")
_PUNCTUAL = Pattern("timing.punctual", "ticks are on time again: 99 of 100 within {ms:.2f} ms")

_LATE_S, _PUNCTUAL_S = 1e-3, 0.5e-3  # [s] p99 that is late, p99 that is punctual again
_MEASURED_S = 2.0  # [s] of ticks before they are judged
_LOOK_S = 1.0


class TimingReport:
    """Monitor that checks control's timing statistics once a second.

    `asked` is True if the deployment requests the real-time scheduling class for control.
    """

    def __init__(self, shared: SharedState, rate: float, priority: int, asked: bool) -> None:
        self._shared_state = shared
        self._rate = rate
        self._priority = priority
        self._asked = asked
        self._next = 0.0
        self._class = ""  # the class that was reported
        self._late = False

    def poll(self, now: float) -> list[Event]:
        """Return new events about control's timing; [] until control has ticked for a while."""
        if now < self._next:
            return []
        self._next = now + _LOOK_S
        status = self._shared_state.control.read()
        scheduling = bytes(status["scheduling"]).decode()
        if not scheduling or int(status["ticks"]) < _MEASURED_S * self._rate:
            return []
        problems = [*self._judge_class(scheduling), *self._judge(float(status["lateness_p99"]))]
        return [Event(kind, text, now) for kind, text in problems]

    def _judge_class(self, scheduling: str) -> list[tuple[str, str]]:
        if scheduling == self._class:
            return []
        self._class = scheduling
        advice = realtime.advice(scheduling, self._priority) if self._asked else ""
        return [("scheduling", advice)] if advice else []

    def _judge(self, p99: float) -> list[tuple[str, str]]:
        if not self._late and p99 > _LATE_S:
            self._late = True
            return [("late_ticks", _LATE(ms=p99 * 1000))]
        if self._late and p99 < _PUNCTUAL_S:
            self._late = False
            return [("punctual", _PUNCTUAL(ms=p99 * 1000))]
        return []
