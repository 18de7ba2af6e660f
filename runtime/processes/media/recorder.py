"""Recorder: turns ticks, observations and chunks into an episode with rows on the dataset grid."""

from __future__ import annotations

import math
import time
import uuid
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from runtime.core.errors import RecordingError
from runtime.core.sentences import Pattern, fixed
from runtime.core.types import Float32, Observation
from runtime.ipc.messages import Event, ExecutedTick, MergeResult, PolicyAnswer, event_row
from runtime.processes.media.camera_rows import CameraRows
from runtime.processes.media.chunk_log import ChunkLog
from runtime.recording.base import VIDEO_LOST, Journal, Outcome, Row, Status
from runtime.recording.bench_truth import truth_text
from runtime.recording.files import UnclosedError
from runtime.recording.schema import Schema
from runtime.recording.settings import RecordingSettings

_EPISODE_OPEN = Pattern("recording.episode_open", "episode {episode} is still open")
_NO_OBSERVATION = fixed(
    "recording.no_observation",
    "no observation has arrived: nothing is known of the cameras yet",
)
_NO_PICTURE = Pattern("recording.no_picture", "no picture has arrived from {cameras}")

_OBSERVATIONS_KEPT = 256  # ticks arrive within a few ms, later after a stall; at 200 Hz this is one second


@dataclass(frozen=True, slots=True)
class DatasetGrid:
    """Robot and dataset grid of an episode: names, sizes and rates."""

    robot: Mapping[str, Any]  # in the form of the manifest
    cameras: tuple[str, ...]
    control_rate: float
    fps: float
    eef_of: Callable[[Float32], Float32]  # joints [D] -> poses [8 * arms]
    recording: RecordingSettings = field(default_factory=RecordingSettings)


@dataclass(frozen=True, slots=True)
class ClosedEpisode:
    """Result of closing an episode."""

    uuid: str
    path: Path
    status: Status
    reason: str
    rows: int
    error: str = ""
    retry: Callable[[], ClosedEpisode] | None = None  # if its end waits for room on the disk: tries again


class Recorder:
    """Sampler on the dataset grid: row k is the last tick not later than k / fps after the first recorded tick.

    A row in a gap of missed ticks repeats the previous tick; its pictures are flagged repeats.
    """

    def __init__(self, journal: Journal, root: Path, grid: DatasetGrid, now: Callable[[], float]) -> None:
        self._journal = journal
        self._root = root
        self._grid = grid
        self._now = now
        self._seen: deque[Observation] = deque(maxlen=_OBSERVATIONS_KEPT)
        self._uuid = ""
        self.rows = 0
        self.repeated = 0  # number of pictures that rows of this episode repeated

    @property
    def recording(self) -> str:
        """uuid of the open episode, "" without one."""
        return self._uuid

    # --- the episode ---------------------------------------------------------------------------------------

    def begin(self, manifest: Mapping[str, Any], run: int) -> tuple[str, Path]:
        """Open an episode and return its uuid and folder. Raises RecordingError.

        If `run` is 0, the episode records every tick, otherwise only the ticks of the run with that number.
        """
        if self._uuid:
            raise RecordingError(_EPISODE_OPEN(episode=self._uuid))
        if not self._seen:
            raise RecordingError(_NO_OBSERVATION)
        newest = self._seen[-1]
        self._schema = Schema.from_manifest(manifest)
        self._cameras = self._schema.recorded_cameras(self._grid.cameras)
        missing = [camera for camera in self._cameras if camera not in newest.pictures]
        if missing:
            raise RecordingError(_NO_PICTURE(cameras=", ".join(missing)))
        self._schema.check(newest)
        self._shown = CameraRows(self._cameras, self._grid.recording)
        identity = str(manifest.get("uuid") or uuid.uuid4())
        self._journal.begin(self._manifest(dict(manifest), identity, newest))
        self._uuid, self._run, self.rows, self.repeated = identity, run, 0, 0
        self._first_step: int | None = None
        self._before: tuple[ExecutedTick, Observation | None] | None = None
        self._complete = False
        self._news: list[Event] = []
        self._applied: Float32 | None = None  # newest action that the robot reported
        self._lost: list[str] = []  # sentences about cameras whose video has ended
        self._bench = ""  # ground truth of a simulated bench in the previous row
        self._chunks = ChunkLog(self._journal)
        return identity, self._root / identity

    def _manifest(self, manifest: dict[str, Any], identity: str, newest: Observation) -> dict[str, Any]:
        grid = self._grid
        has_eef, posed = newest.eef is not None, bool(grid.robot["eef_dim"])
        skew = self._schema.max_skew_s or grid.recording.max_skew_s
        return manifest | {
            "format": 1,
            "uuid": identity,
            "robot": dict(grid.robot),
            "fps": grid.fps,
            "control_rate": grid.control_rate,
            "cameras": self._shown.sizes(newest),
            "streams": self._schema.streams(
                qvel=newest.qvel is not None, effort=newest.effort is not None, posed=posed
            ),
            "capture_streams": ["joints", *(["eef"] if has_eef else []), *self._cameras],
            "max_skew_s": skew,
            "started_wall": time.time(),
            "started_monotonic": self._now(),
        }

    def end(self, status: Status, reason: str, details: Mapping[str, Any]) -> Callable[[], ClosedEpisode]:
        """End the episode: it accepts nothing more.

        The returned function closes its files, on any thread, and may wait for the disk; until it has returned no other
        episode may begin. `ClosedEpisode.error` names the parts that could not be saved.
        """
        error, rows, lost = "", self.rows, self._lost
        identity, path = self._uuid, self._root / self._uuid
        try:
            self._chunks.flush()
            for event in self._shown.flush(self._now()):
                self._journal.append_event(event_row(event))
        except RecordingError as fault:
            error = str(fault)
        self._uuid = ""
        outcome = Outcome("failed" if error else status, error or reason, time.time(), details)

        losses = list(lost)

        def attempt(finish: Callable[[], None]) -> ClosedEpisode:
            failure, retry = error, None
            try:
                finish()
            except UnclosedError as fault:
                failure, retry = str(fault), partial(attempt, fault.again)
            except RecordingError as fault:
                failure = str(fault)
            causes = "; ".join(filter(None, (failure or reason, *losses)))
            return ClosedEpisode(
                identity, path, "failed" if failure else status, causes, rows, failure, retry
            )

        def end_journal() -> None:
            try:
                self._journal.end(outcome)
            finally:
                losses.extend(loss.text for loss in self._journal.pop_lost_cameras())

        return partial(attempt, end_journal)

    def pop_events(self) -> list[Event]:
        """Return events of the open episode since the last call; they are already in its log."""
        if not self._uuid:
            return []
        for loss in self._journal.pop_lost_cameras():
            self._lost.append(loss.text)
            self._news.append(
                Event(VIDEO_LOST, loss.text, self._now(), data={"camera": loss.camera, "row": loss.row})
            )
        events, self._news = self._news, []
        return events

    # --- input ---------------------------------------------------------------------------------------------

    def add_observation(self, observation: Observation) -> None:
        """Add an observation from reception.

        The caller must add it before the record of a tick that used the observation.
        """
        self._seen.append(observation)

    def add_event(self, event: Mapping[str, Any]) -> None:
        """Record an event, if an episode is open."""
        if self._uuid:
            self._journal.append_event(event)

    def add_answer(self, answer: PolicyAnswer) -> None:
        """Add a chunk as the policy returned it."""
        if self._uuid and answer.run == self._run:
            self._chunks.add_answer(answer)

    def add_merge(self, merged: MergeResult) -> None:
        """Add the placement of a chunk by control, which may come before the chunk itself."""
        if self._uuid and merged.run == self._run:
            self._chunks.add_merge(merged)

    def add_tick(self, tick: ExecutedTick) -> None:
        """Record one control tick, and write the rows of the dataset grid that are complete with this tick.

        Ticks are recorded at the full control rate.
        """
        if not self._uuid or self._complete or (self._run and tick.run != self._run):
            return
        if self._schema.reported:
            applied = self._reported_tick(tick)
            if applied is None:
                return
            tick = applied
        if self._first_step is None:
            self._first_step = tick.step
        self._journal.append(tick)
        pair = (tick, self._observation(tick.sequence))
        # After a gap of missed ticks several rows may be complete; those within the gap repeat the tick before it.
        while (target := self._target(self.rows)) <= tick.step:
            chosen = pair if target == tick.step or self._before is None else self._before
            self._write_row(*chosen)
        self._before = pair
        self._complete = pair[1] is not None and pair[1].last

    def _reported_tick(self, tick: ExecutedTick) -> ExecutedTick | None:
        """Return the tick with the action that a node-driven robot reported; None before its first report.

        If the node reported none for this frame, the last action is repeated with source "none".
        """
        observation = self._observation(tick.sequence)
        reported = None if observation is None else observation.reported_action
        if reported is not None:
            self._applied = reported
        if self._applied is None:
            return None
        return replace(tick, executed=self._applied, source="none" if reported is None else "teleop")

    def _target(self, row: int) -> int:
        """Return the control step at which row `row` is due.

        The row is recorded from the last tick whose step is not later than this step.
        """
        assert self._first_step is not None
        # The tolerance prevents that rounding moves a row which falls exactly on a tick to the previous tick.
        return self._first_step + math.floor(row * self._grid.control_rate / self._grid.fps + 1e-9)

    def _observation(self, sequence: int) -> Observation | None:
        for observation in reversed(self._seen):
            if observation.sequence == sequence:
                return observation
        return None

    def _write_row(self, tick: ExecutedTick, observation: Observation | None) -> None:
        """Write one row of the dataset grid for a tick.

        `observation` is the one that the tick used, None if it is no longer available. Joints are taken from the tick,
        so that a row always has them.
        """
        action = tick.qpos if tick.executed is None else tick.executed
        measured = None if observation is None else observation.eef
        reported = None if observation is None else _reported_eef(observation, action)
        with_eef = bool(self._grid.robot["eef_dim"])
        pictures = self._shown.pictures(observation)
        self.repeated += sum(picture is None for picture in pictures.values())
        for event in self._shown.check_ages(tick.planned, self.rows):
            self._news.append(event)
            self._journal.append_event(event_row(event))
        row = Row(
            index=self.rows,
            step=tick.step,
            tick_time=tick.planned,
            sequence=tick.sequence,
            qpos=tick.qpos,
            action=action,
            captured={} if observation is None else observation.captured,
            pictures=pictures,
            control_source=tick.source,
            qvel=None if observation is None else observation.qvel,
            effort=None if observation is None else observation.effort,
            eef=self._eef(measured, tick.qpos) if with_eef else None,
            eef_action=self._eef(reported, action) if with_eef else None,
            eef_measured=measured is not None,
            eef_action_reported=reported is not None,
            intervention=tick.source == "teleop",
            stale=self._shown.stale,
            lost=self._shown.lost,
            bench=self._bench_changed(observation),
        )
        self._journal.append(row)
        self.rows += 1

    def _bench_changed(self, observation: Observation | None) -> str | None:
        """Return the ground truth of a simulated bench if it differs from the previous row, else None."""
        text = "" if observation is None or not observation.truth else truth_text(observation.truth)
        if not text or text == self._bench:
            return None
        self._bench = text
        return text

    def _eef(self, eef: Float32 | None, joints: Float32) -> Float32:
        """Return the reported poses `eef`; if None, the poses of `joints` by forward kinematics."""
        return self._grid.eef_of(joints) if eef is None else eef


def _reported_eef(observation: Observation, action: Float32) -> Float32 | None:
    """Return the poses that the robot reported for exactly this action; None otherwise."""
    if observation.reported_action is None or not np.array_equal(observation.reported_action, action):
        return None
    return observation.reported_action_eef
