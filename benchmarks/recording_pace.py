"""Frames for any recorder, and the pace of a camera.

Imports only numpy, because the interpreters of other recorders run it, too.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

FPS = 30
CAMERAS = ("cam_high", "cam_left_wrist", "cam_right_wrist")
HEIGHT, WIDTH = 480, 640
JOINTS = 14
_LATE_S = 1.0 / FPS


class Frames:
    """Images on disk, RGB uint8 [N, cameras, H, W, 3], played forwards and backwards for continuous motion."""

    def __init__(self, path: Path) -> None:
        self._pictures = np.load(path, mmap_mode="r")

    def __call__(self, index: int) -> dict[str, Any]:
        """Return the images [H, W, 3] of frame `index` by camera, as copies."""
        turn = 2 * len(self._pictures) - 2
        place = min(index % turn, turn - index % turn)
        return {camera: np.array(self._pictures[place, number]) for number, camera in enumerate(CAMERAS)}


def joints(index: int) -> Any:
    """Return the joints of frame `index`, float32 [14] rad."""
    return np.sin(index / FPS + np.arange(JOINTS)).astype(np.float32)


@dataclass(frozen=True, slots=True)
class RecorderCost:
    """Cost of an episode for a recorder; processor times include child processes [s]."""

    frames: int
    capture_cpu_s: float
    save_cpu_s: float  # until the dataset contains the episode
    save_s: float
    add_mean_ms: float  # delay of the caller per frame
    add_p99_ms: float
    add_max_ms: float
    late: int  # frames given more than a period late, because the previous one took so long
    bytes: int
    peak_mb: float

    def fields(self) -> dict[str, Any]:
        """Return the fields by name, as values for JSON."""
        return asdict(self)


def feed_frames(frames: Frames, count: int, add: Callable[[int, dict[str, Any]], None]) -> dict[str, Any]:
    """Call `add` for `count` frames at 30 Hz; return the fields of a RecorderCost that are known then."""
    took, late = [], 0
    before = processor_s()
    own = 0.0  # for creating the frames, which is not the recorder's
    begun = time.monotonic()
    for index in range(count):
        drawn = time.thread_time()
        pictures = frames(index)
        own += time.thread_time() - drawn
        wait = begun + index / FPS - time.monotonic()
        late += wait < -_LATE_S
        time.sleep(max(0.0, wait))
        start = time.monotonic()
        add(index, pictures)
        took.append((time.monotonic() - start) * 1000.0)
    return {
        "frames": count,
        "capture_cpu_s": processor_s() - before - own,
        "add_mean_ms": float(np.mean(took)),
        "add_p99_ms": float(np.percentile(took, 99)),
        "add_max_ms": float(np.max(took)),
        "late": late,
    }


def finish(given: dict[str, Any], save: Callable[[], None], folder: Path) -> RecorderCost:
    """Call `save`, which writes the episode to `folder`, and return the complete cost."""
    before, begun = processor_s(), time.monotonic()
    save()
    return RecorderCost(
        **given,
        save_cpu_s=processor_s() - before,
        save_s=time.monotonic() - begun,
        bytes=sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()),
        peak_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
    )


def processor_s() -> float:
    """Return the processor time of this process and of its child processes that have ended [s]."""
    used = [resource.getrusage(target) for target in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)
