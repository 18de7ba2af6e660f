"""Turns ticks, observations and answers into an episode: one row of the dataset grid per picture."""

from __future__ import annotations

import math
import time
import uuid
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from runtime.errors import RecordingError
from runtime.messages import ChunkMerged, PolicyAnswer, TickDone
from runtime.recording.base import ExecutedTick, Journal, Outcome, RawChunk, Row, Status
from runtime.types import Float32, Observation, UInt8

_OBSERVATIONS_KEPT = 24  # ticks reach us within a few ms; at 30 Hz this is most of a second
_CHUNKS_KEPT = 256


@dataclass(frozen=True, slots=True)
class Grid:
    """The robot's side of an episode: names, sizes and rates."""

    robot: Mapping[str, Any]  # as the manifest has it
    cameras: tuple[str, ...]
    control_rate: float
    fps: float
    eef_of: Callable[[Float32], Float32]  # joints [D] -> poses [8 * arms]


@dataclass(frozen=True, slots=True)
class Closed:
    """A finished episode."""

    uuid: str
    path: Path
    status: Status
    reason: str
    rows: int
    error: str = ""


class Recorder:
    """Samples on the dataset's grid: row k is the last tick not after k / fps since the first one recorded.

    A row that falls into a gap of missed ticks repeats the tick before it; its pictures are flagged repeats.
    """

    def __init__(self, journal: Journal, root: Path, grid: Grid, now: Callable[[], float]) -> None:
        self._journal = journal
        self._root = root
        self._grid = grid
        self._now = now
        self._seen: deque[Observation] = deque(maxlen=_OBSERVATIONS_KEPT)
        self._uuid = ""
        self.rows = 0
        self.repeated = 0  # pictures that rows of this episode had to repeat

    @property
    def recording(self) -> str:
        """The uuid of the open episode, "" where none is."""
        return self._uuid

    # --- the episode ---------------------------------------------------------------------------------------

    def begin(self, manifest: Mapping[str, Any], run: int) -> tuple[str, Path]:
        """Open an episode; raises RecordingError. `run` 0 takes every tick, else those of that run alone."""
        if self._uuid:
            raise RecordingError(f"episode {self._uuid} is still open")
        if not self._seen:
            raise RecordingError("no observation has arrived: nothing is known of the cameras yet")
        newest = self._seen[-1]
        missing = [camera for camera in self._grid.cameras if camera not in newest.pictures]
        if missing:
            raise RecordingError(f"no picture has arrived from {', '.join(missing)}")
        identity = str(manifest.get("uuid") or uuid.uuid4())
        self._journal.begin(self._manifest(dict(manifest), identity, newest))
        self._uuid, self._run, self.rows, self.repeated = identity, run, 0, 0
        self._first_step: int | None = None
        self._before: tuple[TickDone, Observation | None] | None = None
        self._complete = False
        self._shown: dict[str, float] = {}
        self._answers: dict[int, PolicyAnswer] = {}
        self._merged: dict[int, ChunkMerged] = {}
        return identity, self._root / identity

    def _manifest(self, manifest: dict[str, Any], identity: str, newest: Observation) -> dict[str, Any]:
        grid = self._grid
        has_eef = newest.eef is not None
        sizes = {
            camera: {"width": newest.pictures[camera].shape[1], "height": newest.pictures[camera].shape[0]}
            for camera in grid.cameras
        }
        return manifest | {
            "format": 1,
            "uuid": identity,
            "robot": dict(grid.robot),
            "fps": grid.fps,
            "control_rate": grid.control_rate,
            "cameras": sizes,
            "streams": {
                "qvel": newest.qvel is not None,
                "effort": newest.effort is not None,
                "eef": bool(grid.robot["eef_dim"]),
                "eef_action": bool(grid.robot["eef_dim"]),
            },
            "capture_streams": ["joints", *(["eef"] if has_eef else []), *grid.cameras],
            "started_wall": time.time(),
            "started_monotonic": self._now(),
        }

    def end(self, status: Status, reason: str, details: Mapping[str, Any]) -> Callable[[], Closed]:
        """End the episode: nothing more is taken for it.

        What is returned closes its files, on any thread, and may wait for the disk; until it is done no other
        episode may begin. What could not be saved is named in `Closed.error`.
        """
        error, rows = "", self.rows
        identity, path = self._uuid, self._root / self._uuid
        try:
            for answer in list(self._answers.values()):
                self._write_chunk(answer, None)
        except RecordingError as fault:
            error = str(fault)
        self._uuid = ""
        outcome = Outcome("failed" if error else status, error or reason, time.time(), details)

        def close() -> Closed:
            failure = error
            try:
                self._journal.end(outcome)
            except RecordingError as fault:
                failure = str(fault)
            return Closed(identity, path, "failed" if failure else status, failure or reason, rows, failure)

        return close

    # --- what comes in -------------------------------------------------------------------------------------

    def see(self, observation: Observation) -> None:
        """An observation from the source, before any tick has seen it."""
        self._seen.append(observation)

    def mark(self, event: Mapping[str, Any]) -> None:
        """An event for the log; nothing where no episode is open."""
        if self._uuid:
            self._journal.mark(event)

    def answered(self, answer: PolicyAnswer) -> None:
        """A chunk as the policy gave it."""
        if self._uuid and answer.run == self._run:
            merged = self._merged.pop(answer.chunk_id, None)
            if merged is None:
                self._answers[answer.chunk_id] = answer
            else:
                self._write_chunk(answer, merged)

    def merged(self, merged: ChunkMerged) -> None:
        """Where control put a chunk; may come before the chunk itself."""
        if self._uuid and merged.run == self._run:
            answer = self._answers.pop(merged.chunk_id, None)
            if answer is not None:
                self._write_chunk(answer, merged)
            elif len(self._merged) < _CHUNKS_KEPT:
                self._merged[merged.chunk_id] = merged

    def _write_chunk(self, answer: PolicyAnswer, merged: ChunkMerged | None) -> None:
        targets = np.full(len(answer.actions), -1, np.int64)
        if merged is not None:
            # A row of the policy counts for the first step that was made from it.
            for step, row in zip(merged.targets[::-1], answer.source_rows[::-1], strict=True):
                targets[row] = step
        metres, radians, flags = _met(answer)
        self._journal.append(
            RawChunk(
                chunk_id=answer.chunk_id,
                observation_step=answer.observation_step,
                arrival_step=merged.arrival_step if merged else -1,
                actions=answer.actions,
                target_steps=targets,
                space="eef" if answer.space == "eef" else "joint",
                delay=merged.delay if merged else -1,
                mistimed=merged.mistimed if merged else 0,
                inference_ms=answer.inference_ms,
                strategy=merged.strategy if merged else "",
                overlap=merged.overlap if merged else 0,
                ik_position_error=metres,
                ik_rotation_error=radians,
                ik_flags=flags,
                eef=answer.eef,
            )
        )

    def tick(self, tick: TickDone) -> None:
        """One control tick; writes the full-rate stream, and every row of the grid that is now known."""
        if not self._uuid or self._complete or (self._run and tick.run != self._run):
            return
        if self._first_step is None:
            self._first_step = tick.step
        self._journal.append(_executed(tick))
        here = (tick, self._observation(tick.sequence))
        while (target := self._target(self.rows)) <= tick.step:
            chosen = here if target == tick.step or self._before is None else self._before
            self._write_row(*chosen)
        self._before = here
        self._complete = here[1] is not None and here[1].last

    def _target(self, row: int) -> int:
        """The step at or before which row `row` was sampled."""
        assert self._first_step is not None
        return self._first_step + math.floor(row * self._grid.control_rate / self._grid.fps + 1e-9)

    def _observation(self, sequence: int) -> Observation | None:
        for observation in reversed(self._seen):
            if observation.sequence == sequence:
                return observation
        return None

    def _write_row(self, tick: TickDone, seen: Observation | None) -> None:
        """`seen` is what the tick saw, None where that is not known any more; its joints came with it."""
        action = tick.qpos if tick.executed is None else tick.executed
        measured = None if seen is None else seen.eef
        reported = None if seen is None else _reported_eef(seen, action)
        with_eef = bool(self._grid.robot["eef_dim"])
        row = Row(
            index=self.rows,
            step=tick.step,
            tick_time=tick.planned,
            sequence=tick.sequence,
            qpos=tick.qpos,
            action=action,
            captured={} if seen is None else seen.captured,
            pictures=self._new_pictures(seen),
            control_source=tick.source,  # type: ignore[arg-type]  # control writes nothing else
            qvel=None if seen is None else seen.qvel,
            effort=None if seen is None else seen.effort,
            eef=self._eef(measured, tick.qpos) if with_eef else None,
            eef_action=self._eef(reported, action) if with_eef else None,
            eef_measured=measured is not None,
            eef_action_reported=reported is not None,
        )
        self._journal.append(row)
        self.rows += 1

    def _eef(self, told: Float32 | None, joints: Float32) -> Float32:
        """Poses as the robot told them, else by forward kinematics."""
        return self._grid.eef_of(joints) if told is None else told

    def _new_pictures(self, seen: Observation | None) -> dict[str, UInt8 | None]:
        """The observation's pictures; None for a camera whose picture an earlier row has already."""
        pictures: dict[str, UInt8 | None] = {}
        for camera in self._grid.cameras:
            picture = None if seen is None else seen.pictures.get(camera)
            captured = math.nan if seen is None else seen.captured.get(camera, math.nan)
            if captured == self._shown.get(camera):
                picture = None
            if picture is not None:
                self._shown[camera] = captured
            self.repeated += picture is None
            pictures[camera] = picture
        return pictures


def _reported_eef(seen: Observation, action: Float32) -> Float32 | None:
    """The poses that the robot reports for this very action; None where it reports another one, or none."""
    if seen.reported_action is None or not np.array_equal(seen.reported_action, action):
        return None
    return seen.reported_action_eef


def _met(answer: PolicyAnswer) -> tuple[Float32 | None, Float32 | None, UInt8 | None]:
    """How each row [H, arms] of the policy was met: the worst error [m, rad] and all flags of the steps made of it.

    NaN and no flag for a row that no step was made of, None for a chunk of joints.
    """
    errors, flags = (answer.position_error, answer.rotation_error), answer.ik_flags
    if errors[0] is None or errors[1] is None or flags is None:
        return None, None, None
    shape = (len(answer.actions), flags.shape[1])
    made: list[Float32] = []
    for error in errors:
        assert error is not None
        worst = np.full(shape, np.nan, np.float32)
        np.fmax.at(worst, answer.source_rows, error.astype(np.float32))
        made.append(worst)
    gathered = np.zeros(shape, np.uint8)
    np.bitwise_or.at(gathered, answer.source_rows, flags)
    return made[0], made[1], gathered


def _executed(tick: TickDone) -> ExecutedTick:
    return ExecutedTick(
        step=tick.step,
        planned=tick.planned,
        sent=tick.sent,
        sequence=tick.sequence,
        control_source=tick.source,  # type: ignore[arg-type]
        qpos=tick.qpos,
        smoothed=tick.smoothed,
        executed=tick.executed,
        chunk_ids=tuple(tick.chunk_ids),
        weights=tuple(tick.weights),
        changes=tuple(tick.notes),
        refused=tick.refused,
        woke=tick.woke,
    )
