"""Media process: the only writer of episodes, and source of previews."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from concurrent.futures import Future, wait
from dataclasses import replace
from pathlib import Path
from typing import Any

from runtime.core import process_limits as descriptors
from runtime.core import process_limits as heap
from runtime.core.clock import Clock, MonotonicClock
from runtime.core.errors import RecordingError
from runtime.core.sentences import Pattern, fixed
from runtime.core.types import Observation
from runtime.ipc.membership import rest_s
from runtime.ipc.messages import (
    BeginEpisode,
    BeginRun,
    EndEpisode,
    EndRun,
    EpisodeClosed,
    EpisodeOpened,
    Event,
    ExecutedTick,
    MediaReport,
    MergeResult,
    Message,
    Observed,
    PolicyAnswer,
    RunBegun,
    decode,
    encode,
    event_row,
)
from runtime.ipc.observation_messages import as_observation
from runtime.ipc.shared_memory import TornReadError
from runtime.ipc.shared_state import RecorderStage, SharedState
from runtime.kinematics.base import ChainForward
from runtime.processes.child import join_station
from runtime.processes.media.crash_repair import start_repair
from runtime.processes.media.export_jobs import ExportQueue
from runtime.processes.media.low_priority_worker import LowPriorityWorker
from runtime.processes.media.previews import Previews
from runtime.processes.media.recorder import ClosedEpisode, DatasetGrid, Recorder
from runtime.processes.media.unclosed_episodes import Close, UnclosedEpisodes, at_once, in_background
from runtime.recording.episode import EpisodeJournal
from runtime.spaces.end_effectors import EndEffectors
from runtime.station.spec import StationSpec

log = logging.getLogger(__name__)
_COORDINATOR_SILENT = fixed(
    "media.coordinator_silent",
    "the coordinator has given no sign of life since it was restarted",
)
_END_NEVER_TOLD = fixed("media.end_never_told", "no end received; another recording begins")
_STILL_WRITING = fixed(
    "media.still_writing",
    "the last episode is still being written: is the disk slow? try again in a moment",
)
_SUCCESS = fixed("media.success", "success")
_NO_SUCCESS = fixed("media.no_success", "no success")
_TRUTH = Pattern("media.truth", "the simulated bench says: {how}")
_SUPERVISOR_ENDED = fixed("media.supervisor_ended", "the station's supervisor ended")
# Packages of a deployment that others may write: a fault in their modules must not cost a recording.
_UNREAD = (
    "runtime.policies",
    "runtime.teleoperators",
    "runtime.cameras",
    "runtime.kinematics",
    "runtime.strategies",
)
_REPORT_PERIOD = 0.2
_PERIOD_S = 0.002  # polling period while something is recorded [s]
_LAST_S = 8.0  # for the last episode; less than the supervisor's patience [s]
_EXPORT_S = 3.0  # part of that for running exports [s]; a worker or a person makes the missing ones
_CLOSING_S = (
    1.0  # a new episode waits at most this long for the previous one [s]; longer means a disk in trouble
)


class Media:
    """Recorder and previews of one station; `poll` handles all messages that wait. Lockstep calls it tick by tick."""

    def __init__(
        self,
        shared: SharedState,
        recorder: Recorder,
        clock: Clock,
        preview: Callable[[Observation], None] = lambda observation: None,
        closer: Callable[[Close], Future[ClosedEpisode]] = at_once,
        on_disk: Callable[[Path], None] = lambda folder: None,
    ) -> None:
        self._shared_state = shared
        self._recorder = recorder
        self._clock = clock
        self._preview = preview
        self._closer = closer
        self._on_disk = on_disk  # called with every closed episode
        self._unclosed = UnclosedEpisodes(closer, clock.now)
        self._closing: Future[ClosedEpisode] | None = None
        self._closing_uuid = ""
        self._waiting: BeginEpisode | None = None  # request that waits until the previous episode is closed
        self._waiting_since = 0.0
        self._opened: EpisodeOpened | None = None  # sent to the coordinator when the source has begun the run
        self._newest = 0  # sequence of the newest observation
        self._truth: Mapping[str, Any] = {}  # ground truth of a simulated bench, as last reported
        self._next_report = 0.0
        self._generation = shared.generation("coordinator")
        for ring in ("observations", "minutes", "ticks"):
            for _ in shared.rings[ring].drain():
                pass  # addressed to a predecessor that died
        self._ask_source(EndRun())

    @property
    def recording(self) -> bool:
        return bool(self._recorder.recording)

    @property
    def closing(self) -> bool:
        """True while the last episode is being closed."""
        return self._closing is not None

    @property
    def rests(self) -> bool:
        """True while no episode is open, requested or being closed; then only messages wake the process."""
        going_on = self.recording, self.closing, self._waiting is not None, self._opened is not None
        return not any(going_on)

    def poll(self) -> None:
        """Handle all messages of reception, control and the coordinator."""
        died = (
            self._shared_state.generation("coordinator") != self._generation
        )  # all its messages are in the rings
        if died and self._waiting is not None and self._waiting.generation == self._generation:
            self._waiting = None
        self.report_closed()
        with self._shared_state.recorder_stage(
            RecorderStage.WRITING if self.recording else RecorderStage.WAITING
        ):
            self._drain("observations")
            self._drain("minutes")
            self._drain("ticks")
        if died:
            self._end_orphaned_episode()
        for event in self._recorder.pop_events():
            log.warning("%s", event.text)
            self._send(event)
        if self._clock.now() >= self._next_report:
            self.report()

    def _end_orphaned_episode(self) -> None:
        """End the episode of a coordinator that has died, after the ticks that are still waiting.

        The coordinator's successor does not know the episode.
        """
        generation = self._shared_state.generation("coordinator")
        if generation != self._generation:
            self._drain("ticks")
            self._generation = generation
            self._waiting = self._opened = None
            self.end("interrupted", _COORDINATOR_SILENT)
            self._ask_source(EndRun())

    def _drain(self, ring: str) -> None:
        if ring == "minutes" and not self._ready_to_begin():
            return
        for payload in self._shared_state.rings[ring].drain():
            self._dispatch(decode(payload))
            if self._waiting is not None and ring == "minutes":
                return  # later messages belong to an episode that has not begun

    def _ready_to_begin(self) -> bool:
        """Begin the requested episode if one is waiting and may begin; return False if it must continue to wait.

        A requested episode waits until the previous episode is closed, or until closing has taken too long. Return True
        if no episode is waiting any more.
        """
        waiting = self._waiting
        if waiting is None:
            return True
        if self._closing is not None and self._clock.now() - self._waiting_since < _CLOSING_S:
            return False
        self._waiting = None
        self._begin(waiting)
        return True

    def _dispatch(self, message: Message) -> None:
        try:
            self._write(message)
        except RecordingError as error:
            self._fail(error)

    def _write(self, message: Message) -> None:
        recorder = self._recorder
        if isinstance(message, Observed):
            self._observe(message)
        elif isinstance(message, ExecutedTick):
            if message.sequence > self._newest:  # observations reach the ring before the tick that used them
                self._drain("observations")
            recorder.add_tick(message)
        elif isinstance(message, MergeResult):
            recorder.add_merge(message)
        elif isinstance(message, PolicyAnswer):
            recorder.add_answer(message)
        elif isinstance(message, Event):
            recorder.add_event(event_row(message))
        elif isinstance(message, BeginEpisode):
            self._end_orphaned_episode()  # the coordinator may have died and been replaced since this poll began
            if message.generation != self._generation:
                log.warning("run %d of a coordinator that has died is not recorded", message.run)
                return
            self.end("interrupted", _END_NEVER_TOLD)
            if self._closing is None:
                self._begin(message)
            else:
                self._waiting, self._waiting_since = message, self._clock.now()
        elif isinstance(message, RunBegun):
            self._run_begun(message)
        elif isinstance(message, EndEpisode):
            self._drain("ticks")  # ticks that control ran before the coordinator decided to end
            self._emit_truth(message.details.get("reached") or {})
            self.end(message.status, message.reason, message.details)
            self._opened = None
            self._ask_source(EndRun())

    def _observe(self, message: Observed) -> None:
        observation = as_observation(message, self._shared_state)
        self._newest, self._truth = message.sequence, message.truth or {}
        self._recorder.add_observation(observation)
        self._preview(observation)

    def _begin(self, message: BeginEpisode) -> None:
        self._shared_state.set_unrecorded(False)  # before the start is announced
        opened = EpisodeOpened(message.run, "", "")
        if message.manifest is not None:
            with self._shared_state.recorder_stage(RecorderStage.OPENING):
                opened = self._open(message.run, message.manifest)
        if opened.error or not message.run:
            self._send(opened)
        else:
            self._opened = opened
            self._ask_source(BeginRun(message.run, self._generation))

    def _open(self, run: int, manifest: Mapping[str, Any]) -> EpisodeOpened:
        if self._closing is not None:
            error = _STILL_WRITING
            return EpisodeOpened(run, "", "", error)
        try:
            # With its present pictures: those of an earlier observation may be overwritten before they are read.
            if (newest := self._shared_state.read_observation(self._shared_state.layout.cameras)) is not None:
                same = newest.sequence == self._newest  # shared state has no ground truth
                self._recorder.add_observation(replace(newest, truth=self._truth or None) if same else newest)
            identity, path = self._recorder.begin(manifest, run)
        except (RecordingError, TornReadError) as fault:
            return EpisodeOpened(run, "", "", str(fault))
        return EpisodeOpened(run, identity, str(path))

    def _run_begun(self, message: RunBegun) -> None:
        """Report to the coordinator that the episode is open, now that the source's run has begun.

        The report waits for this so that the first frame of the source's run is in the first tick of the run.
        """
        opened = self._opened
        if opened is not None and message == RunBegun(opened.run, self._generation):
            self._send(opened)
            self._opened = None

    def _ask_source(self, message: BeginRun | EndRun) -> None:
        if not self._shared_state.rings["source"].push(encode(message)):
            log.warning("reception does not read: %s lost", type(message).__name__)

    def end(self, status: str, reason: str, details: Mapping[str, Any] | None = None) -> None:
        """Close the open episode, if there is one; the coordinator is informed when that is done."""
        if self._recorder.recording:
            self._closing_uuid = self._recorder.recording
            with self._shared_state.recorder_stage(RecorderStage.CLOSING):
                self._closing = self._closer(self._recorder.end(status, reason, details or {}))  # type: ignore[arg-type]
            self.report_closed()

    def finish(self, seconds: float) -> None:
        """Wait at most `seconds` [s] for an episode that is being closed; repair completes it otherwise."""
        if self._closing is not None:
            wait([self._closing], seconds)
            self.report_closed()
        if self._closing is not None:
            log.error("episode %s was not closed within %g s", self._closing_uuid, seconds)
        while (late := self._unclosed.finish(seconds)) is not None:
            self._closed(late)
        for uuid, reason in self._unclosed.errors.items():
            log.error("episode %s has no outcome, the next start completes it: %s", uuid, reason)

    def report_closed(self) -> None:
        """Inform the coordinator of episodes that have been closed."""
        if (late := self._unclosed.poll()) is not None:
            self._closed(late)
        if self._closing is None or not self._closing.done():
            return
        closed, self._closing, self._closing_uuid = self._closing.result(), None, ""
        self._closed(closed)

    def _closed(self, closed: ClosedEpisode) -> None:
        waits = closed.retry is not None
        path, outcome = str(closed.path), (closed.status, closed.reason, closed.rows, closed.error)
        self._send(EpisodeClosed(closed.uuid, path, *outcome, waits))
        if waits:
            log.error("episode %s waits for room on the disk: %s", closed.uuid, closed.error)
            self._unclosed.add(closed)
        else:
            self._on_disk(closed.path)

    def _fail(self, error: RecordingError) -> None:
        log.error("recording failed: %s", error)
        self._send(Event("recording_failed", str(error), self._clock.now()))
        self.end("failed", str(error))

    def report(self) -> None:
        """Send the coordinator a report; `poll` does this five times a second."""
        recorder, now = self._recorder, self._clock.now()
        self._next_report = now + _REPORT_PERIOD
        recording = recorder.recording or self._closing_uuid  # until it is on disk
        fields = (recorder.rows, recording, recorder.repeated, self._unclosed.errors)
        self._send(MediaReport(now, *fields))

    def _emit_truth(self, reached: Mapping[str, float]) -> None:
        """Report the final state of a simulated bench and the times of its milestones: the episode's score."""
        truth = self._truth
        if truth:
            how = _SUCCESS if truth["success"] else _NO_SUCCESS
            data = {**truth, "reached": dict(reached), "episode": self._recorder.recording}
            self._emit(Event("truth", _TRUTH(how=how), self._clock.now(), data=data))

    def _emit(self, event: Event) -> None:
        """Send an event of media to the coordinator, and record it in the episode."""
        self._send(event)
        self._dispatch(event)

    def _send(self, message: Message) -> None:
        if not self._shared_state.rings["media_events"].push(encode(message)):
            log.warning("the coordinator does not read: %s lost", type(message).__name__)


def make_recorder(spec: StationSpec, now: Callable[[], float], patient: bool = False) -> Recorder:
    """Create the recorder of a deployment; if `patient`, as for lockstep, it waits for the video encoders."""
    robot = spec.robot
    described = {
        "name": robot.name,
        "joint_names": list(robot.joint_names),
        "eef_names": list(robot.eef_names),
        "eef_frames": {arm.name: arm.frame for arm in robot.arms},
        "dim": robot.dim,
        "eef_dim": robot.eef_dim,
    }
    root, recording = spec.deployment.episodes_dir, spec.deployment.recording
    journal = EpisodeJournal(root, recording, patient=patient)
    eef_of = EndEffectors(robot, ChainForward(robot)).eef_of
    grid = DatasetGrid(described, spec.cameras, spec.rate, spec.fps, eef_of, recording)
    return Recorder(journal, root, grid, now)


def main() -> None:
    """Run media until the supervisor has ended."""
    heap.keep_freed_memory()
    descriptors.raise_file_limit()
    member = join_station("media", unread=_UNREAD)
    spec, shared = member.spec, member.shared
    clock = MonotonicClock()
    shared.beat("media", clock.now())
    shared.set_unrecorded(False)  # a predecessor may have died with the flag set
    exports = ExportQueue(spec.deployment.data, spec.deployment.recording.export)
    start_repair(spec.deployment.episodes_dir, spec.deployment.station, exports.submit)
    previews = LowPriorityWorker(Previews(spec))  # previews may be late on a busy machine, recordings may not
    media = Media(shared, make_recorder(spec, clock.now), clock, previews, in_background, exports.submit)
    bell, wait_s = shared.bells["media"], rest_s(spec.deployment.control.heartbeat_timeout_s)
    try:
        while not member.lifeline.is_cut:
            now = clock.now()
            shared.beat("media", now)
            media.poll()
            within = spec.deployment.heartbeat_timeout_s("coordinator")
            if media.recording and not shared.alive("coordinator", now, within):
                media.end(
                    "interrupted",
                    f"the coordinator has given no sign of life {shared.describe_silence('coordinator', now)}",
                )
            if media.rests:
                shared.set_unrecorded(True)
                bell.wait(wait_s)
            else:
                clock.sleep_until(now + _PERIOD_S)
    finally:
        media.end("interrupted", _SUPERVISOR_ENDED)
        ended = clock.now()
        media.finish(_LAST_S)
        exports.finish(min(_EXPORT_S, _LAST_S - (clock.now() - ended)))
        previews.close()


if __name__ == "__main__":
    main()
