"""Inbox of the coordinator: messages from control, reception and media, and their consequences."""

from __future__ import annotations

from collections.abc import Iterator

from runtime.core.sentences import Pattern
from runtime.ipc.messages import (
    ALL_SUBSCRIBED,
    NO_SUBSCRIBER,
    EpisodeClosed,
    EpisodeOpened,
    Event,
    MediaReport,
    MergeResult,
    Message,
    ReceptionReport,
    decode,
)
from runtime.ipc.session_state import SessionState
from runtime.processes.coordinator.components import Components
from runtime.processes.coordinator.session.transitions import SessionEvent

_CHUNK_DROPPED = Pattern("inbox.chunk_dropped", "chunk {chunk} dropped: {why}")
_STARVED_BECAUSE = Pattern("inbox.starved_because", "{why}: {trouble}")
_RECORDING = Pattern("inbox.recording", "recording {episode}")

_RINGS = ("control_events", "reception_events", "media_events")
# Kinds of events with control's own reasons to hold.
_HOLDS = ("refusals", "implausible", "unmeasured", "family", "orphaned", "too_far", "moved_away")


class Inbox:
    """Dispatcher of the other processes' messages to the coordinator's components; stores their latest reports."""

    def __init__(self, coordinator: Components) -> None:
        self._to = coordinator
        self.media_report = MediaReport(0.0, 0, "", 0)
        self.reception_report = ReceptionReport(0.0)
        self.unheard: dict[str, str] = {}  # as from Sink.missing_subscribers
        for (
            message
        ) in self._waiting():  # from before this coordinator started: its predecessor has handled them
            if isinstance(message, Event):
                self._store_event(message)

    def poll(self) -> None:
        """Dispatch all waiting messages."""
        for message in self._waiting():
            self._dispatch(message)

    def reset_subscribers(self) -> None:
        """Clear the missing subscribers: a restarted control reports them again."""
        self.unheard = {}

    def _waiting(self) -> Iterator[Message]:
        for ring in _RINGS:
            for payload in self._to.shared.rings[ring].drain():
                yield decode(payload)

    def _dispatch(self, message: Message) -> None:
        to = self._to
        if isinstance(message, Event):
            self._on_event(message)
        elif isinstance(message, MergeResult):
            to.inference.on_merged(message)
            if message.dropped:
                text = _CHUNK_DROPPED(chunk=message.chunk_id, why=message.dropped)
                to.emit(Event("chunk_dropped", text, to.clock.now(), message.arrival_step))
        elif isinstance(message, EpisodeOpened):
            self._episode_opened(message)
        elif isinstance(message, EpisodeClosed):
            to.emit(to.runs.on_episode_closed(message))
            to.collecting.on_episode_closed(message)
        elif isinstance(message, MediaReport):
            self.media_report = message
        elif isinstance(message, ReceptionReport):
            self.reception_report = message
            to.runs.update_truth(message.truth, to.session.state is SessionState.RUNNING)

    def _on_event(self, event: Event) -> None:
        to, settings = self._to, self._to.spec.deployment
        self._store_event(event)
        to.setup.on_event(event)
        if event.kind == "motion_done":
            to.runs.on_motion_done()
        if event.kind == "joints_back":
            to.inference.forget_plan()
        if event.kind == "starved":
            to.inference.metrics.count_starved()
        if event.kind == "starvation":
            trouble = to.inference.problem
            stops = settings.faults.starvation == "stop"
            reason = _STARVED_BECAUSE(why=event.text, trouble=trouble) if trouble else event.text
            to.handle_event(SessionEvent.RUN_FAILED if stops else SessionEvent.HELD, reason)
        elif event.kind in _HOLDS or (
            event.kind == "recording_failed" and settings.recording.on_failure == "hold"
        ):
            to.handle_event(SessionEvent.HELD, event.text)
        elif event.kind == "displaced":
            to.handle_event(SessionEvent.DISPLACED, event.text)

    def _store_event(self, event: Event) -> None:
        self._to.record_event(event)
        if event.kind in (NO_SUBSCRIBER, ALL_SUBSCRIBED):
            self.unheard = dict(event.data["unheard"])

    def _episode_opened(self, opened: EpisodeOpened) -> None:
        to = self._to
        if opened.error:
            to.emit(Event("recording_failed", opened.error, to.clock.now()))
        elif opened.uuid:
            to.emit(Event("episode_opened", _RECORDING(episode=opened.uuid), to.clock.now()))
        failure = to.runs.on_episode_opened(opened, to.session.state is SessionState.RUNNING)
        if failure:
            to.collecting.on_open_failed()
            to.handle_event(SessionEvent.RUN_FAILED, failure)
