"""Pictures of each camera in the rows of an episode: each used once, with age checks and dropout events."""

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


QUIET_S = 5.0  # shortest time between two pictures_stopped events of a camera [s]


@dataclass(slots=True)
class _Camera:
    silent: bool = False
    row: int = 0  # row of the last change
    said: bool = False  # its dropout has been reported, but not its return
    unsaid: int = 0  # number of dropouts since the last report
    unsaid_from: int = 0  # row of the first of these
    spoken: float = -math.inf  # time of the last report [s]

    def set_silent(self, silent: bool, row: int) -> None:
        """Record that the camera stops sending at row `row` (`silent`) or sends again."""
        self.silent, self.row = silent, row
        if silent:
            self.unsaid_from = self.unsaid_from if self.unsaid else row
            self.unsaid += 1

    def is_due(self, now: float) -> bool:
        """Return True if an event about the camera is due at time `now` [s]."""
        return (self.said and not self.silent) or (self.unsaid > 0 and now - self.spoken >= QUIET_S)

    def to_event(self, name: str, now: float, age: float | None) -> Event:
        """Return the event about the camera's present state; `age` is the age of its last picture [s]."""
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
    """Dropouts of the cameras of one episode, updated row by row.

    For each camera, at most one dropout and one return are reported within QUIET_S. Further dropouts in that time are
    only counted. When it is over, one event reports the camera's present state and how many dropouts were counted.
    """

    def __init__(self, cameras: Iterable[str]) -> None:
        self._cameras = {name: _Camera() for name in sorted(cameras)}

    def update(self, now: float, row: int, silent: Mapping[str, float]) -> list[Event]:
        """Return the events of lost and returned cameras that are due at row `row` and time `now` [s].

        `silent` maps each camera whose newest picture is too old to the age of that picture [s].
        """
        events = []
        for name, camera in self._cameras.items():
            if (name in silent) != camera.silent:
                camera.set_silent(name in silent, row)
            if camera.is_due(now):
                events.append(camera.to_event(name, now, silent.get(name)))
        return events

    def flush(self, now: float) -> list[Event]:
        """Return the events that were counted but not reported, at the end of the episode."""
        return [camera.to_event(name, now, None) for name, camera in self._cameras.items() if camera.unsaid]


class CameraRows:
    """Pictures of the cameras of one episode, updated row by row."""

    def __init__(self, cameras: Sequence[str], settings: RecordingSettings) -> None:
        self._cameras = tuple(cameras)
        self._settings = settings
        self._captured: dict[str, float] = {}  # capture time of the newest used picture
        self._began: float | None = None
        self._silences = DropoutLog(cameras)
        self.stale: frozenset[str] = frozenset()  # cameras whose picture is too old for the newest row
        self.lost: frozenset[str] = frozenset()  # cameras whose new picture for the newest row is gone

    def sizes(self, seen: Observation) -> dict[str, dict[str, int]]:
        """Return width and height of each video, and of the camera's pictures if these are scaled for the video."""
        pictures = {camera: seen.pictures[camera] for camera in self._cameras}
        captured = {camera: (picture.shape[0], picture.shape[1]) for camera, picture in pictures.items()}
        sizes = {}
        for camera, (height, width) in self._settings.sizes(captured).items():
            sizes[camera] = {"width": width, "height": height}
            if (height, width) != captured[camera]:
                sizes[camera] |= {
                    "captured_width": captured[camera][1],
                    "captured_height": captured[camera][0],
                }
        return sizes

    def pictures(self, seen: Observation | None) -> Mapping[str, UInt8 | None]:
        """Return the observation's pictures; None for a picture that is lost or was used by an earlier row."""
        pictures: dict[str, UInt8 | None] = dict.fromkeys(self._cameras)
        lost = set()
        if seen is None:  # the observation of the row's tick has not arrived
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
        """Check the ages of the pictures at row `row` and time `now` [s]; return dropout and return events."""
        self._began = now if self._began is None else self._began
        ages = {camera: now - self._captured.get(camera, self._began) for camera in self._cameras}
        old = {camera: age for camera, age in ages.items() if age > self._settings.max_picture_age_s}
        self.stale = frozenset(old)
        return self._silences.update(now, row, old)

    def flush(self, now: float) -> list[Event]:
        """Return the remaining events at the end of the episode."""
        return self._silences.flush(now)
