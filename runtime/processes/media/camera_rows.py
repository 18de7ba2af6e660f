"""Pictures of each camera in the rows of an episode: each once, and how old the newest one is."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from runtime.core.types import Observation, UInt8
from runtime.ipc.messages import Event
from runtime.processes.media.dropouts import DropoutLog
from runtime.recording.settings import RecordingSettings


class CameraRows:
    """Follows the cameras of one episode row by row."""

    def __init__(self, cameras: Sequence[str], settings: RecordingSettings) -> None:
        self._cameras = tuple(cameras)
        self._settings = settings
        self._captured: dict[str, float] = {}  # of the newest picture that a row has
        self._began: float | None = None
        self._silences = DropoutLog(cameras)
        self.stale: frozenset[str] = frozenset()  # cameras whose newest picture is too old for the newest row
        self.lost: frozenset[str] = (
            frozenset()
        )  # cameras whose picture for the newest row was there, and is gone

    def sizes(self, seen: Observation) -> dict[str, dict[str, int]]:
        """Sizes of each video, and of the pictures of its camera where they are scaled for it."""
        pictures = {camera: seen.pictures[camera] for camera in self._cameras}
        given = {camera: (picture.shape[0], picture.shape[1]) for camera, picture in pictures.items()}
        sizes = {}
        for camera, (height, width) in self._settings.sizes(given).items():
            sizes[camera] = {"width": width, "height": height}
            if (height, width) != given[camera]:
                sizes[camera] |= {"captured_width": given[camera][1], "captured_height": given[camera][0]}
        return sizes

    def pictures(self, seen: Observation | None) -> Mapping[str, UInt8 | None]:
        """The observation's pictures; None for a camera whose picture an earlier row has already, or that is lost."""
        pictures: dict[str, UInt8 | None] = dict.fromkeys(self._cameras)
        lost = set()
        if seen is None:  # what the row's tick saw has not come to us: nor have its pictures
            self.lost = frozenset(self._cameras)
            return pictures
        for camera in self._cameras:
            captured = seen.captured.get(camera, math.nan)
            if camera not in seen.pictures or captured == self._captured.get(camera):
                continue
            self._captured[camera] = captured
            pictures[camera] = seen.pictures.get(camera)
            if pictures[camera] is None:
                lost.add(camera)
        self.lost = frozenset(lost)
        return pictures

    def look(self, now: float, row: int) -> list[Event]:
        """Judge the age of what row `row` shows at `now` [s]; cameras that fall silent or are back are events."""
        self._began = now if self._began is None else self._began
        ages = {camera: now - self._captured.get(camera, self._began) for camera in self._cameras}
        old = {camera: age for camera, age in ages.items() if age > self._settings.max_picture_age_s}
        self.stale = frozenset(old)
        return self._silences.look(now, row, old)

    def rest(self, now: float) -> list[Event]:
        """Events about the cameras that are left to be said when the episode ends."""
        return self._silences.rest(now)
