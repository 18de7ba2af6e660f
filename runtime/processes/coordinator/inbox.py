"""Inbox of the coordinator: what control, reception and media say, and what follows from it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from runtime.core.sentences import Pattern
from runtime.ipc.messages import (
    HEARD,
    UNHEARD,
    ChunkMerged,
    EpisodeClosed,
    EpisodeOpened,
    Event,
    MediaReport,
    Message,
    ReceptionReport,
    decode,
)
from runtime.ipc.session_state import SessionState
from runtime.processes.coordinator.session.transitions import SessionEvent

if TYPE_CHECKING:
    from runtime.processes.coordinator.coordinator import Coordinator

_CHUNK_DROPPED = Pattern("inbox.chunk_dropped", "chunk {chunk} dropped: {why}")
_STARVED_BECAUSE = Pattern("inbox.starved_because", "{why}: {trouble}")
_RECORDING = Pattern("inbox.recording", "recording {episode}")

_RINGS = ("control_events", "reception_events", "media_events")
# Control's own reasons to hold, as events of these kinds.
_HOLDS = ("refusals", "implausible", "unmeasured", "family", "orphaned", "too_far", "moved_away")


class Inbox:
    """Messages of the other processes, each carried to the parts that it is for; the newest of their reports."""

    def __init__(self, coordinator: Coordinator) -> None:
        self._to = coordinator
        self.media_report = MediaReport(0.0, 0, "", 0)
        self.reception_report = ReceptionReport(0.0)
        self.unheard: dict[str, str] = {}  # as by Sink.unheard
        for (
            message
        ) in self._waiting():  # of before there was a coordinator, or since one died: told to that one
            if isinstance(message, Event):
                self._keep(message)

    def read(self) -> None:
        """Hear all that waits."""
        for message in self._waiting():
            self._hear(message)

    def forget_unheard(self) -> None:
        """Control is started anew: it says again who does not hear it."""
        self.unheard = {}

    def _waiting(self) -> Iterator[Message]:
        for ring in _RINGS:
            for payload in self._to.shared.rings[ring].drain():
                yield decode(payload)

    def _hear(self, message: Message) -> None:
        to = self._to
        if isinstance(message, Event):
            self._hear_event(message)
        elif isinstance(message, ChunkMerged):
            to.inference.merged(message)
            if message.dropped:
                text = _CHUNK_DROPPED(chunk=message.chunk_id, why=message.dropped)
                to.say(Event("chunk_dropped", text, to.clock.now(), message.arrival_step))
        elif isinstance(message, EpisodeOpened):
            self._episode_opened(message)
        elif isinstance(message, EpisodeClosed):
            to.say(to.runs.closed(message))
            to.collecting.closed(message)
        elif isinstance(message, MediaReport):
            self.media_report = message
        elif isinstance(message, ReceptionReport):
            self.reception_report = message
            to.runs.saw(message.truth, to.session.state is SessionState.RUNNING)

    def _hear_event(self, event: Event) -> None:
        to, settings = self._to, self._to.spec.deployment
        self._keep(event)
        to.setup.heard(event)
        if event.kind == "motion_done":
            to.runs.arrived()
        if event.kind == "joints_back":
            to.inference.forget_plan()
        if event.kind == "starved":
            to.inference.metrics.count_starved()
        if event.kind == "starvation":
            trouble = to.inference.trouble
            stops = settings.faults.starvation == "stop"
            why = _STARVED_BECAUSE(why=event.text, trouble=trouble) if trouble else event.text
            to.observe(SessionEvent.RUN_FAILED if stops else SessionEvent.HELD, why)
        elif event.kind in _HOLDS or (
            event.kind == "recording_failed" and settings.recording.on_failure == "hold"
        ):
            to.observe(SessionEvent.HELD, event.text)
        elif event.kind == "displaced":
            to.observe(SessionEvent.DISPLACED, event.text)

    def _keep(self, event: Event) -> None:
        self._to.log(event)
        if event.kind in (UNHEARD, HEARD):
            self.unheard = dict(event.data["unheard"])

    def _episode_opened(self, opened: EpisodeOpened) -> None:
        to = self._to
        if opened.error:
            to.say(Event("recording_failed", opened.error, to.clock.now()))
        elif opened.uuid:
            to.say(Event("episode_opened", _RECORDING(episode=opened.uuid), to.clock.now()))
        failure = to.runs.opened(opened, to.session.state is SessionState.RUNNING)
        if failure:
            to.collecting.unopened()
            to.observe(SessionEvent.RUN_FAILED, failure)
