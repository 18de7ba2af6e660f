"""Checks of one camera's pictures: present, of the declared size, on time, neither black nor uniform, not repeated."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from runtime.core.errors import RecordingError
from runtime.core.types import Float32, Float64
from runtime.quality.block import Bools, EpisodeSource
from runtime.quality.frame_stream import FrameStream, LumaFrame
from runtime.quality.lost_frames import LostFrames
from runtime.quality.report import Flag, FlagCollector, FrameRun, RunCollector, Severity, frame_range
from runtime.quality.settings import QualitySettings

CHANGED = 10.0  # multiple of `same`: a change that only motion causes


class ImageCheck:
    """Check that decodes the pictures of one camera in step with its rows."""

    def __init__(
        self, source: EpisodeSource, camera: str, settings: QualitySettings, flags: FlagCollector
    ) -> None:
        end = source.ends.get(camera)
        self._camera = camera
        self._fps = source.fps
        self._size = source.cameras[camera]
        self._settings = settings
        self._flags = flags
        self._film: FrameStream | None = None
        self._shots: Iterator[LumaFrame] = iter(())
        self._shown = 0  # number of pictures that were read
        self._before: Float32 | None = None
        self._repeats = _RepeatCheck(camera, self._fps, settings, flags, drawn=source.drawn)
        self._losses = LostFrames(camera, self._fps, settings, flags, end)
        self._runs = {
            "black": RunCollector(self._black),
            "uniform": RunCollector(self._uniform),
            "video_time": RunCollector(self._off_time),
            "no_picture": RunCollector(self._absent),
        }
        self._strange: tuple[int, int] | None = None
        if end is not None and end.row == 0:
            return  # there may be no file
        try:
            self._film = source.open_frames(camera, settings.sampling)
            self._shots = iter(self._film)
        except RecordingError as error:
            self._flag("video", "error", -1, -1, str(error))

    def add(
        self, first: int, moving: Bools, repeated: Bools | None = None, lost: Bools | None = None
    ) -> None:
        """Check the pictures of the next rows.

        Args:
            first: Index of the first of these rows.
            moving: Rows in which the robot moves [N].
            repeated: Rows that the recorder marked as having the previous picture again [N]; None: no row.
            lost: Rows whose picture is missing in the video [N]; None: no row.
        """
        rows = len(moving)
        nobody = np.zeros(rows, np.bool_)
        repeated, lost = nobody if repeated is None else repeated, nobody if lost is None else lost
        beyond = self._losses.past_end(first, rows)
        self._losses.add(first, lost)
        figures = np.full((rows, 4), np.nan)  # mean, standard deviation, change, time off the grid
        keys = np.zeros(rows, np.bool_)
        for row in np.flatnonzero(~beyond).tolist():
            shot = self._next(first + row)
            if shot is None:
                break
            figures[row] = self._figures(shot, first + row)
            keys[row] = shot.key
        mean, deviation, change, off = figures.T
        present = np.isfinite(mean)
        if self._film is not None:
            self._runs["no_picture"].add(first, ~present & ~beyond)
        black = present & (mean <= self._settings.black)
        self._runs["black"].add(first, black, -np.nan_to_num(mean))
        uniform = present & ~black & (deviation <= self._settings.uniform)
        self._runs["uniform"].add(first, uniform, -np.nan_to_num(deviation))
        self._runs["video_time"].add(first, np.nan_to_num(off) > 0.5 / self._fps, np.nan_to_num(off))
        self._repeats.add(first, change, keys, black | uniform, moving, repeated & ~beyond, lost)

    def _next(self, frame: int) -> LumaFrame | None:
        try:
            shot = next(self._shots, None)
        except RecordingError as error:
            self._flag("undecodable", "error", frame, frame, str(error))
            self._shots = iter(())
            return None
        self._shown += shot is not None
        return shot

    def _figures(self, shot: LumaFrame, frame: int) -> tuple[float, float, float, float]:
        size = (shot.height, shot.width)
        if self._size is not None and size != self._size and size != self._strange:
            self._strange = size
            text = f"{self._camera} is {size[1]}x{size[0]}, declared is {self._size[1]}x{self._size[0]}"
            self._flag("dimensions", "error", frame, frame, f"from frame {frame} on {text}")
        before, self._before = self._before, shot.luma
        change = np.nan
        if before is not None:
            alike = before.shape == shot.luma.shape
            change = float(np.abs(shot.luma - before).mean()) if alike else np.inf
        off = 0.0 if shot.time is None else abs(shot.time - frame / self._fps)
        return float(shot.luma.mean()), float(shot.luma.std()), change, off

    def close(self, rows: int, whole: bool) -> None:
        """End the checks of an episode with `rows` rows.

        `whole`: all rows were readable, so that further pictures are surplus.
        """
        for runs in self._runs.values():
            runs.close()
        self._losses.close(rows)
        self._repeats.close(self._shown)
        if self._film is None:
            return
        ended = self._losses.past_end(rows, 1).all()
        if whole and not ended and self._next(self._shown) is not None:
            text = f"{self._camera} has more pictures than there are rows, {self._shown - 1}"
            self._flag("video_length", "info", -1, -1, text)

    def release(self) -> None:
        """Close the video, however the check ended."""
        if self._film is not None:
            self._film.close()

    def _black(self, run: FrameRun) -> None:
        text = f"{frame_range(run.first, run.last)}: {self._camera} is black, mean brightness {-run.value:.1f} of 255"
        self._flag("black", self._lasting(run), run.first, run.last, text, -run.value, self._settings.black)

    def _uniform(self, run: FrameRun) -> None:
        where = frame_range(run.first, run.last)
        text = f"{where}: {self._camera} shows nothing, brightness varies by {-run.value:.2f}"
        self._flag(
            "uniform", self._lasting(run), run.first, run.last, text, -run.value, self._settings.uniform
        )

    def _lasting(self, run: FrameRun) -> Severity:
        return "error" if run.frames / self._fps > self._settings.picture_age_s else "warning"

    def _off_time(self, run: FrameRun) -> None:
        text = f"{frame_range(run.first, run.last)}: {self._camera} is shown {run.value:.3f} s off its row"
        self._flag("video_time", "error", run.first, run.last, text, run.value, 0.5 / self._fps)

    def _absent(self, run: FrameRun) -> None:
        text = f"{frame_range(run.first, run.last)}: {self._camera} has no picture, only {self._shown}"
        self._flag(
            "video_length", "error", run.first, run.last, text, float(self._shown), float(run.last + 1)
        )

    def _flag(
        self,
        kind: str,
        severity: Severity,
        first: int,
        last: int,
        text: str,
        value: float | None = None,
        bound: float | None = None,
    ) -> None:
        self._flags.add(Flag(kind, severity, first, last, self._camera, text, value, bound))


class _RepeatCheck:
    """Check for repeated pictures: marked by the recorder, or detected while the robot moves.

    An unchanged picture proves nothing while the robot is at rest. A key frame after other frames differs from them
    even if the scene is unchanged, so it does not end a run of unchanged pictures. A `drawn` (simulated) picture is
    unchanged whenever nothing moves in its view, so it is not checked.
    """

    def __init__(
        self, camera: str, fps: float, settings: QualitySettings, flags: FlagCollector, *, drawn: bool
    ) -> None:
        self._camera = camera
        self._fps = fps
        self._settings = settings
        self._flags = flags
        self._drawn = drawn
        self._repeated = self._skipped = 0
        self._spans = {"repeated": [-1, -1], "skipped": [-1, -1]}
        self._said = RunCollector(self._no_new)
        self._seen = RunCollector(self._flag_frozen)
        self._last: Float64 = np.full(2, np.nan)  # changes of the two previous pictures
        self._key = False  # whether the previous picture was a key frame

    def add(
        self,
        first: int,
        change: Float64,
        keys: Bools,
        dull: Bools,
        moving: Bools,
        repeated: Bools,
        lost: Bools,
    ) -> None:
        """Check the next rows [N], from row `first` on.

        Args:
            first: Index of the first of these rows.
            change: Difference of each picture from the one before it.
            keys: Which pictures are key frames.
            dull: Which pictures are black or uniform; these are reported elsewhere.
            moving: Rows in which the robot moves.
            repeated: Rows that the recorder marked as having the previous picture again.
            lost: Rows whose picture is missing in the video; these are reported elsewhere.
        """
        marked = repeated | lost
        self._count("repeated", first, repeated & ~lost)
        self._said.add(first, repeated & ~lost)
        if self._drawn:
            return
        neutral = keys & ~np.concatenate([[self._key], keys[:-1]])
        same = change <= self._settings.same
        self._seen.add(first, (same | neutral) & moving & ~marked & ~dull, same.astype(np.float64))
        # A camera of half the rate shows each picture twice: it changes, stays, changes.
        changes = np.concatenate([self._last, change])
        much = changes > CHANGED * self._settings.same
        doubled = much[:-2] & (changes[1:-1] <= self._settings.same) & much[2:]
        self._count("skipped", first - 1, doubled & ~marked)
        self._last, self._key = changes[-2:], bool(keys[-1])

    def _count(self, kind: str, first: int, marked: Bools) -> None:
        frames = np.flatnonzero(marked)
        if len(frames):
            span = self._spans[kind]
            self._spans[kind] = [
                span[0] if span[0] >= 0 else first + int(frames[0]),
                first + int(frames[-1]),
            ]
        if kind == "repeated":
            self._repeated += len(frames)
        else:
            self._skipped += len(frames)

    def close(self, shown: int) -> None:
        self._said.close()
        self._seen.close()
        for kind, count, text in (
            ("repeated", self._repeated, "are the one before again: no new one came in time"),
            (
                "skipped",
                self._skipped,
                "repeat the picture before without being marked as repeated: the camera is slower than the rows",
            ),
        ):
            share = count / shown if shown else 0.0
            if count:
                many = share > self._settings.repeated_share
                if kind == "skipped" and not many:
                    continue  # single repeats prove nothing
                first, last = self._spans[kind]
                sentence = f"{count} of {shown} pictures of {self._camera} {text}"
                severity: Severity = "warning" if many else "info"
                bound = self._settings.repeated_share
                self._flags.add(
                    Flag("duplicate", severity, first, last, self._camera, sentence, share, bound)
                )

    def _no_new(self, run: FrameRun) -> None:
        seconds, bound = run.frames / self._fps, self._settings.picture_age_s
        if seconds > bound:
            text = (
                f"{frame_range(run.first, run.last)}: {self._camera} gave no new picture for {seconds:.1f} s"
            )
            self._frozen("error", run, text, seconds, bound)

    def _flag_frozen(self, run: FrameRun) -> None:
        seconds, bound = run.frames / self._fps, self._settings.frozen_s
        if seconds > bound:
            where = frame_range(run.first, run.last)
            text = f"{where}: {self._camera} shows one picture for {seconds:.1f} s while the robot moves"
            self._frozen("warning", run, text, seconds, bound)

    def _frozen(self, severity: Severity, run: FrameRun, text: str, seconds: float, bound: float) -> None:
        self._flags.add(Flag("frozen", severity, run.first, run.last, self._camera, text, seconds, bound))
