"""Checks of time: consecutive rows, increasing clocks, and streams captured together and recently."""

from __future__ import annotations

import numpy as np

from runtime.core.types import Float64
from runtime.quality.block import Block, EpisodeSource
from runtime.quality.report import Flag, FlagCollector, FrameRun, RunCollector, Severity, frame_range
from runtime.quality.settings import QualitySettings

JOINTS = ("joints", "eef")  # streams that are not cameras


class TimingCheck:
    """Check of the order of rows, gaps between them, capture skew and ages, block by block."""

    def __init__(self, source: EpisodeSource, settings: QualitySettings, flags: FlagCollector) -> None:
        self._source = source
        self._settings = settings
        self._flags = flags
        stated = source.schema.get("max_skew_s")
        self._skew = float(stated) if isinstance(stated, int | float) and stated > 0 else settings.max_skew_s
        self._before: dict[str, float] = {}  # newest value of each clock and stream
        self._index: int | None = None
        self._runs: dict[tuple[str, str], RunCollector] = {}
        self.largest_skew: float | None = None

    def add(self, block: Block) -> None:
        """Check the next rows."""
        if block.index is not None:
            self._numbered(block, block.index)
        for name, clock in block.clocks.items():
            self._clock(block, name, clock)
        for stream, times in block.captured.items():
            self._forwards(block, f"capture_time.{stream}", times, again=True)
            self._mark("capture_unknown", stream, block, ~np.isfinite(times))
        if "timestamp" in block.clocks:
            self._grid(block, block.clocks["timestamp"])
        if len(block.captured) > 1:
            self._apart(block)
        if self._source.started in block.clocks:
            self._ages(block, block.clocks[self._source.started])

    def close(self) -> None:
        """End the checks."""
        for runs in self._runs.values():
            runs.close()

    def _numbered(self, block: Block, index: np.ndarray[tuple[int], np.dtype[np.int64]]) -> None:
        before = self._index if self._index is not None else int(index[0]) - 1 if block.first else -1
        steps = np.diff(np.concatenate([[before], index]))
        for place in np.flatnonzero(steps != 1):
            frame = block.first + int(place)
            was = before if place == 0 else int(index[place - 1])
            text = (
                f"row {int(index[place])} follows row {was}"
                if frame
                else f"the first row is number {int(index[0])}"
            )
            self._flag(
                "missing_rows",
                "error",
                frame,
                "",
                f"{text}: rows are missing, or out of order",
                float(steps[place]),
                1.0,
            )
        self._index = int(index[-1])

    def _clock(self, block: Block, name: str, clock: Float64) -> None:
        self._mark("time_missing", name, block, ~np.isfinite(clock))
        gaps = self._forwards(block, name, clock, again=False)
        if name == self._source.started:
            bound = self._settings.max_gap_frames / self._source.fps
            self._mark("gap", name, block, gaps > bound + 1e-9, gaps)

    def _forwards(self, block: Block, name: str, times: Float64, *, again: bool) -> Float64:
        """Return the differences [s] between each time and the last known time before it, [N].

        A negative difference is flagged. A difference of zero is flagged unless `again` is True, which permits the same
        time again.
        """
        finite = np.isfinite(times)
        steps = np.full(len(times), np.nan)
        finite_times = times[finite]
        if len(finite_times):
            steps[finite] = np.diff(np.concatenate([[self._before.get(name, np.nan)], finite_times]))
            self._before[name] = float(finite_times[-1])
        wrong = steps < 0 if again else steps <= 0
        self._mark("time_order", name, block, wrong, -steps)
        return steps

    def _grid(self, block: Block, stamps: Float64) -> None:
        off = np.abs(stamps - (block.first + np.arange(block.rows)) / self._source.fps)
        # Stamps may have float32 precision, as datasets store the column.
        bound = np.maximum(
            self._settings.timestamp_tolerance_s, np.spacing(np.abs(stamps).astype(np.float32))
        )
        self._mark("time_grid", "timestamp", block, off > bound, off)

    def _apart(self, block: Block) -> None:
        times = np.stack(list(block.captured.values()))
        finite = np.isfinite(times)
        spread = np.where(finite, times, -np.inf).max(axis=0) - np.where(finite, times, np.inf).min(axis=0)
        spread[finite.sum(axis=0) < 2] = 0.0
        self.largest_skew = max(self.largest_skew or 0.0, float(spread.max(initial=0.0)))
        self._mark("skew", "", block, spread > self._skew, spread)

    def _ages(self, block: Block, ticks: Float64) -> None:
        for stream, times in block.captured.items():
            bound = self._settings.joint_age_s if stream in JOINTS else self._settings.picture_age_s
            ages = ticks - times
            self._mark("stale", stream, block, ages > bound, ages)

    def _mark(
        self,
        kind: str,
        stream: str,
        block: Block,
        wrong: np.ndarray[tuple[int], np.dtype[np.bool_]],
        values: Float64 | None = None,
    ) -> None:
        place = (kind, stream)
        if place not in self._runs:
            self._runs[place] = RunCollector(lambda run: self._flag_run(kind, stream, run))
        values = None if values is None else np.nan_to_num(values, nan=0.0)
        self._runs[place].add(block.first, wrong, values)

    def _flag_run(self, kind: str, stream: str, run: FrameRun) -> None:
        where, value = frame_range(run.first, run.last), run.value
        settings = self._settings
        age = settings.joint_age_s if stream in JOINTS else settings.picture_age_s
        findings: dict[str, tuple[Severity, str, float | None, float | None]] = {
            "capture_unknown": ("info", f"{where}: the capture times of {stream} are unknown", None, None),
            "time_missing": ("error", f"{where}: {stream} is not a number", None, None),
            "time_order": ("error", f"{where}: {stream} does not go forwards, by {value:.4f} s", value, 0.0),
            "gap": (
                "warning",
                f"{where}: {value:.3f} s since the row before, {value * self._source.fps:.1f} periods",
                value,
                settings.max_gap_frames / self._source.fps,
            ),
            "time_grid": (
                "error",
                f"{where}: timestamp is {value:.5f} s off frame / fps, loaders refuse that",
                value,
                settings.timestamp_tolerance_s,
            ),
            "skew": ("warning", f"{where}: streams captured up to {value:.3f} s apart", value, self._skew),
            "stale": ("warning", f"{where}: {stream} is up to {value:.3f} s old", value, age),
        }
        severity, text, worst, bound = findings[kind]
        self._flags.add(Flag(kind, severity, run.first, run.last, stream, text, worst, bound))

    def _flag(
        self, kind: str, severity: Severity, frame: int, stream: str, text: str, value: float, bound: float
    ) -> None:
        self._flags.add(Flag(kind, severity, frame, frame, stream, text, value, bound))
