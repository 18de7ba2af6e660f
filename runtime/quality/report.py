"""Report of the checks on an episode: flags with their frames, and whether it is clean."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Severity = Literal["info", "warning", "error"]
SEVERITIES: tuple[Severity, ...] = ("info", "warning", "error")
FORMAT = 1


@dataclass(frozen=True, slots=True)
class Flag:
    """One finding in the frames `first` to `last`, both included; both -1 if it concerns no frame.

    `stream` is a column or a camera, "" for the episode. `value` is the worst value, `bound` the allowed one, both in
    the unit that `text` names; None if the finding has no number.
    """

    kind: str
    severity: Severity
    first: int
    last: int
    stream: str
    text: str
    value: float | None = None
    bound: float | None = None


@dataclass(frozen=True, slots=True)
class Count:
    """Number of flags of one kind and of their frames; flags that the report omits are included."""

    flags: int
    frames: int


@dataclass(frozen=True, slots=True)
class Report:
    """Report of all findings on one episode.

    `unchecked` are sentences about checks that were impossible, with the reason.
    """

    episode: str  # uuid, or DATASET#index
    frames: int
    fps: float
    flags: tuple[Flag, ...]
    counts: Mapping[str, Count]
    unchecked: tuple[str, ...] = ()
    figures: Mapping[str, float | None] = field(default_factory=dict)

    @property
    def clean(self) -> bool:
        """True if there are no findings above "info"."""
        return self.worst in ("", "info")

    @property
    def worst(self) -> Severity | Literal[""]:
        """Highest severity, "" without flags."""
        severities = {flag.severity for flag in self.flags}
        return next((severity for severity in reversed(SEVERITIES) if severity in severities), "")

    def to_dict(self) -> dict[str, Any]:
        """Return the report as JSON; numbers that are not finite become null."""
        return {
            "format": FORMAT,
            "episode": self.episode,
            "frames": self.frames,
            "fps": self.fps,
            "clean": self.clean,
            "worst": self.worst,
            "flags": [{name: _plain(value) for name, value in asdict(flag).items()} for flag in self.flags],
            "counts": {kind: asdict(count) for kind, count in self.counts.items()},
            "unchecked": list(self.unchecked),
            "figures": {name: _plain(value) for name, value in self.figures.items()},
        }


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


class FlagCollector:
    """Collector of flags in constant memory.

    At most `most` flags per kind and stream are stored, but all are counted.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._kept: list[Flag] = []
        self._seen: Counter[tuple[str, str]] = Counter()
        self._counts: dict[str, Count] = {}
        self.unchecked: list[str] = []

    def add(self, flag: Flag) -> None:
        """Add one finding."""
        place = (flag.kind, flag.stream)
        self._seen[place] += 1
        if self._seen[place] <= self._most:
            self._kept.append(flag)
        before = self._counts.get(flag.kind, Count(0, 0))
        frames = 0 if flag.first < 0 else flag.last - flag.first + 1
        self._counts[flag.kind] = Count(before.flags + 1, before.frames + frames)

    def report(self, episode: str, frames: int, fps: float, figures: Mapping[str, float | None]) -> Report:
        """Return the report; flags are in the order of their frames, and at the same frame the worst comes first."""
        order = sorted(
            self._kept,
            key=lambda flag: (flag.first, -SEVERITIES.index(flag.severity), flag.kind, flag.stream),
        )
        return Report(
            episode,
            frames,
            fps,
            tuple(order),
            dict(sorted(self._counts.items())),
            tuple(self.unchecked),
            figures,
        )


class FrameRun(NamedTuple):
    """Consecutive frames with the same finding; `value` is the worst value among them, found at frame `at`."""

    first: int
    last: int
    value: float
    at: int

    @property
    def frames(self) -> int:
        return self.last - self.first + 1


class RunCollector:
    """Collector that joins marked frames of consecutive blocks into runs and passes each finished run to `ended`.

    Runs separated by at most `apart` unmarked frames are joined.
    """

    def __init__(self, ended: Callable[[FrameRun], None], apart: int = 0) -> None:
        self._ended = ended
        self._apart = apart
        self._open: FrameRun | None = None

    def add(self, first: int, marked: NDArray[np.bool_], values: ArrayLike | None = None) -> None:
        """Add frames from the index `first` on.

        `marked` is True for the frames that have the finding. `values` states how bad each frame is; larger is worse.
        """
        frames = np.flatnonzero(marked)
        if not len(frames):
            if self._open is not None and first + len(marked) - self._open.last > self._apart + 1:
                self.close()
            return
        worst = np.ones(len(marked)) if values is None else np.asarray(values, np.float64)
        breaks = np.flatnonzero(np.diff(frames) > self._apart + 1)
        for part in np.split(frames, breaks + 1):
            at = int(part[np.argmax(worst[part])])
            self._add_run(FrameRun(first + int(part[0]), first + int(part[-1]), float(worst[at]), first + at))

    def _add_run(self, new: FrameRun) -> None:
        current = self._open
        if current is None or new.first - current.last > self._apart + 1:
            self.close()
            self._open = new
            return
        worse = new if new.value > current.value else current
        self._open = FrameRun(current.first, new.last, worse.value, worse.at)

    def close(self) -> None:
        """End the open run, because the episode has ended."""
        if self._open is not None:
            current, self._open = self._open, None
            self._ended(current)


def frame_range(first: int, last: int) -> str:
    """Return a range of frames as text, e.g. "frames 3 to 7"."""
    return f"frame {first}" if first == last else f"frames {first} to {last}"


def listed(names: Sequence[str], most: int = 4) -> str:
    """Return names as text, at most `most` of them."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")
