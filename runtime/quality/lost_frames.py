"""Check for pictures that are missing in a camera's video: in some rows, or from one row on."""

from __future__ import annotations

import numpy as np

from runtime.quality.block import Bools, VideoEnd
from runtime.quality.report import Flag, FlagCollector, FrameRun, RunCollector, Severity, frame_range
from runtime.quality.settings import QualitySettings


class LostFrames:
    """Check for missing pictures of one camera; all rows after the end of its video are one flag."""

    def __init__(
        self, camera: str, fps: float, settings: QualitySettings, flags: FlagCollector, end: VideoEnd | None
    ) -> None:
        self._camera = camera
        self._fps = fps
        self._settings = settings
        self._flags = flags
        self._end = end
        self._runs = RunCollector(self._lost)

    def add(self, first: int, lost: Bools) -> None:
        """Add rows from `first` on; `lost` marks the rows whose picture is missing in the video."""
        self._runs.add(first, lost & ~self.past_end(first, len(lost)))

    def past_end(self, first: int, rows: int) -> Bools:
        """Return which of these rows [N] are past the end of the video."""
        return np.arange(first, first + rows) >= (np.inf if self._end is None else self._end.row)

    def close(self, rows: int) -> None:
        """End the check; the episode has `rows` rows."""
        self._runs.close()
        if self._end is None:
            return
        cause = f"the video of {self._camera} ended: {self._end.reason}"
        if self._end.row < rows:
            text = f"from frame {self._end.row} on {cause}"
            self._flags.add(Flag("video_lost", "error", self._end.row, rows - 1, self._camera, text))
        else:
            text = f"after the last frame {cause}"
            self._flags.add(Flag("video_lost", "warning", -1, -1, self._camera, text))

    def _lost(self, run: FrameRun) -> None:
        seconds, bound = run.frames / self._fps, self._settings.picture_age_s
        severity: Severity = "error" if seconds > bound else "warning"
        where = frame_range(run.first, run.last)
        long = f"{seconds:.1f}" if seconds >= 0.1 else f"{seconds:.2f}"
        text = f"{where}: what {self._camera} gave for {long} s is not in its video, the picture before is"
        self._flags.add(Flag("lost", severity, run.first, run.last, self._camera, text, seconds, bound))
