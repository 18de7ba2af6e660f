"""Events of cameras that stop giving pictures: each while they are seldom, else now and then their number."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from runtime.ipc.messages import Event

QUIET_S = 5.0  # from one pictures_stopped of a camera to its next


@dataclass(slots=True)
class _Camera:
    silent: bool = False
    row: int = 0  # of its newest change
    said: bool = False  # its silence was, and not yet that it is back
    unsaid: int = 0  # how often it fell silent since something was said
    unsaid_from: int = 0  # the row of the first of these
    spoken: float = -math.inf  # when that was

    def turn(self, silent: bool, row: int) -> None:
        """It falls silent at row `row`, or is back."""
        self.silent, self.row = silent, row
        if silent:
            self.unsaid_from = self.unsaid_from if self.unsaid else row
            self.unsaid += 1

    def due(self, now: float) -> bool:
        """Something is to be said of it."""
        return (self.said and not self.silent) or (self.unsaid > 0 and now - self.spoken >= QUIET_S)

    def say(self, name: str, now: float, age: float | None) -> Event:
        """How it is; `age` [s] is that of its last picture."""
        data: dict[str, object] = {"camera": name, "row": self.row}
        if self.silent:
            since = "gives no new picture" if age is None else f"has given no new picture for {age:.1f} s"
            text = f"camera {name} {since}: rows from {self.row} on repeat its last one"
        else:
            text = f"camera {name} gives pictures again, from row {self.row} on"
        if more := self.unsaid - self.silent:
            often = "time" if more == 1 else "times"
            text += f"; it had stopped {more} {often} more since row {self.unsaid_from}"
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

    def look(self, now: float, row: int, silent: Mapping[str, float]) -> list[Event]:
        """Events at row `row`, made at `now` [s]; `silent` has the age [s] of each picture too old."""
        events = []
        for name, camera in self._cameras.items():
            if (name in silent) != camera.silent:
                camera.turn(name in silent, row)
            if camera.due(now):
                events.append(camera.say(name, now, silent.get(name)))
        return events

    def rest(self, now: float) -> list[Event]:
        """Events that were counted and not said yet, at the end of the episode."""
        return [camera.say(name, now, None) for name, camera in self._cameras.items() if camera.unsaid]
