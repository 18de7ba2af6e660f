"""What control tells of its ticks: its status in the page, events to main, a record of each tick to media."""

from __future__ import annotations

import numpy as np

from runtime.actuator import Actuator, Sent
from runtime.behaviour import Behaviour, EStopped
from runtime.messages import ChunkMerged, Event, Message, TickDone, encode
from runtime.page import Page
from runtime.types import Float32


class Report:
    """Gathers what a tick has to say, hands it over at its end; a full ring is counted, never waited for."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._outbox: list[ChunkMerged | Event] = []
        self._records_lost = 0
        self._smoothed: Float32 | None = None  # of this tick: what was wanted before safety
        self.order = 0  # number of the newest order obeyed
        self.run = 0

    def say(self, kind: str, text: str, now: float) -> None:
        """An event, told at the end of the tick."""
        self._outbox.append(Event(kind, text, now))

    def merged(self, merged: ChunkMerged) -> None:
        """Where a chunk fell, told at the end of the tick."""
        self._outbox.append(merged)

    def record(self, step: int, planned: float, observation: np.void, sent: Sent) -> None:
        """The tick, for the episode."""
        target, executed = sent.target, sent.executed
        wanted = target is not None and target.path is not None
        self._smoothed = target.action.astype(np.float32) if target and wanted else None
        source = "none" if executed is None else "hold"
        if target is not None and executed is not None and not sent.refused:
            source = target.source
        done = TickDone(
            step=step,
            run=self.run,
            planned=planned,
            sent=sent.time,
            sequence=int(observation["sequence"]),
            source=source,
            qpos=np.array(observation["qpos"]),
            smoothed=self._smoothed,
            executed=None if executed is None else executed.astype(np.float32),
            chunk_ids=[maker for maker, _ in target.makers] if target else [],
            weights=[share for _, share in target.makers] if target else [],
            notes=list(sent.notes),
            refused=sent.refused,
        )
        self._push("ticks", done)

    def status(
        self,
        step: int,
        planned: float,
        observation: np.void,
        behaviour: Behaviour,
        actuator: Actuator,
        remaining: int,
        refused: int,
    ) -> None:
        """Control's status, and only then the events: main decides by it, so that none may overtake it.

        The tick's record comes before either, so that whoever ends an episode by them loses no row.
        """
        status = self._page.control.read().copy()
        status["step"], status["planned"] = step, planned
        status["sequence"], status["order"] = observation["sequence"], self.order
        status["run"], status["behaviour"] = self.run, behaviour.name.encode()
        status["remaining"] = remaining
        status["engaged"], status["moving"] = actuator.engaged, behaviour.moving
        status["estop_obeyed"] = isinstance(behaviour, EStopped)
        status["commanded"], status["velocity"] = actuator.commanded, actuator.velocity
        status["smoothed"] = np.nan if self._smoothed is None else self._smoothed
        status["refused_in_row"] = refused
        status["records_lost"] = self._records_lost
        self._page.control.write(status)
        for message in self._outbox:
            self._push("control_events", message)
            self._push("ticks", message)
        self._outbox.clear()

    def _push(self, ring: str, message: Message) -> None:
        if not self._page.rings[ring].push(encode(message)):
            self._records_lost += 1
