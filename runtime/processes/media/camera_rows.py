"""Pictures of each camera in the rows of an episode: each once, how old the newest one is, and cameras that stop."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from runtime.core.sentences import Pattern
from runtime.core.types import Observation, UInt8
from runtime.ipc.messages import Event
from runtime.recording.settings import RecordingSettings

_STOPPED = Pattern(
    "media.pictures_stopped",
    "camera {camera} gives no new picture: rows from {row} on repeat its last one",
)
_STOPPED_FOR = Pattern(
    "media.pictures_stopped_for",
    "camera {camera} has given no new picture for {seconds:.1f} s: rows from {row} on repeat its last one",
)
_BACK = Pattern("media.pictures_back", "camera {camera} gives pictures again, from row {row} on")
_ONCE_MORE = Pattern("media.stopped_once_more", "{what}; it stopped {more} more time since row {row}")
_MORE = Pattern("media.stopped_more", "{what}; it stopped {more} more times since row {row}")


QUIET_S = 5.0  # from one pictures_stopped of a camera to its next


@dataclass(slots=True)
class _Camera:
    silent: bool = False
    row: int = 0  # of its newest change
    said: bool = False  # its silence was, and not yet that it is back
    unsaid: int = 0  # how often it fell silent since something was said
    unsaid_from: int = 0  # the row of the first of these
    spoken: float = -math.inf  # when that was

    def set_silent(self, silent: bool, row: int) -> None:
        """It falls silent at row `row`, or is back."""
        self.silent, self.row = silent, row
        if silent:
            self.unsaid_from = self.unsaid_from if self.unsaid else row
            self.unsaid += 1

    def is_due(self, now: float) -> bool:
        """Something is to be said of it."""
        return (self.said and not self.silent) or (self.unsaid > 0 and now - self.spoken >= QUIET_S)

    def to_event(self, name: str, now: float, age: float | None) -> Event:
        """How it is; `age` [s] is that of its last picture."""
        data: dict[str, object] = {"camera": name, "row": self.row}
        if self.silent:
            stopped = {"camera": name, "row": self.row}
            text = _STOPPED(**stopped) if age is None else _STOPPED_FOR(**stopped, seconds=age)
        else:
            text = _BACK(camera=name, row=self.row)
        if more := self.unsaid - self.silent:
            text = (_ONCE_MORE if more == 1 else _MORE)(what=text, more=more, row=self.unsaid_from)
            data |= {"more": more, "since_row": self.unsaid_from}
        if self.unsaid:
            self.spoken = now
        self.said, self.unsaid = self.silent, 0
        return Event("pictures_stopped" if self.silent else "pictures_back", text, now, data=data)


class DropoutLog:
    """Follows the cameras of one episode row by row.

    A camera is said to have stopped, and to be back, at most once in QUIET_S. What comes meanwhile is counted, and said
    when that time is over: as what the camera does then, since its own row, with the number.
    """

    def __init__(self, cameras: Iterable[str]) -> None:
        self._cameras = {name: _Camera() for name in sorted(cameras)}

    def update(self, now: float, row: int, silent: Mapping[str, float]) -> list[Event]:
        """Events at row `row`, made at `now` [s]; `silent` has the age [s] of each picture too old."""
        events = []
        for name, camera in self._cameras.items():
            if (name in silent) != camera.silent:
                camera.set_silent(name in silent, row)
            if camera.is_due(now):
                events.append(camera.to_event(name, now, silent.get(name)))
        return events

    def flush(self, now: float) -> list[Event]:
        """Events that were counted and not said yet, at the end of the episode."""
        return [camera.to_event(name, now, None) for name, camera in self._cameras.items() if camera.unsaid]


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

    def check_ages(self, now: float, row: int) -> list[Event]:
        """Judge the age of what row `row` shows at `now` [s]; cameras that fall silent or are back are events."""
        self._began = now if self._began is None else self._began
        ages = {camera: now - self._captured.get(camera, self._began) for camera in self._cameras}
        old = {camera: age for camera, age in ages.items() if age > self._settings.max_picture_age_s}
        self.stale = frozenset(old)
        return self._silences.update(now, row, old)

    def flush(self, now: float) -> list[Event]:
        """Events about the cameras that are left to be said when the episode ends."""
        return self._silences.flush(now)
