"""Our recorder without a station: `python -m benchmarks.recording_alone FRAMES COUNT FOLDER`; prints JSON."""

from __future__ import annotations

import json
import sys
import time
import uuid
from pathlib import Path
from typing import Any

from benchmarks.recording_pace import CAMERAS, FPS, HEIGHT, JOINTS, WIDTH, Frames, feed_frames, finish, joints
from runtime.datasets.publishing import publish
from runtime.ipc.messages import ExecutedTick
from runtime.recording.base import Outcome, Row
from runtime.recording.episode import EpisodeJournal
from runtime.recording.settings import RecordingSettings

_TICKS = 3  # control ticks per row: 90 Hz


def manifest() -> dict[str, Any]:
    """Return the manifest of an episode with the frames that all recorders in this comparison get."""
    names = [f"joint_{number}" for number in range(JOINTS)]
    robot = {"name": "bench", "joint_names": names, "eef_names": [], "dim": JOINTS, "eef_dim": 0}
    return {
        "format": 1,
        "uuid": str(uuid.uuid4()),
        "station": "bench",
        "robot": robot,
        "fps": float(FPS),
        "control_rate": float(FPS * _TICKS),
        "cameras": {camera: {"width": WIDTH, "height": HEIGHT} for camera in CAMERAS},
        "streams": {"qvel": False, "effort": False, "eef": False, "eef_action": False},
        "capture_streams": ["joints", *CAMERAS],
        "task": "wave",
        "mode": "continuous",
        "strategy": "async",
        "kind": "rollout",
        "started_wall": time.time(),
        "started_monotonic": time.monotonic(),
        "configuration": {},
        "configuration_hash": "0",
        "versions": {},
    }


def append(journal: EpisodeJournal, index: int, pictures: dict[str, Any]) -> None:
    """Append row `index` with its images and ticks."""
    now, position = time.monotonic(), joints(index)
    captured = dict.fromkeys(("joints", *CAMERAS), now)
    journal.append(Row(index, index * _TICKS, now, index, position, position, captured, pictures, "policy"))
    for step in range(index * _TICKS, (index + 1) * _TICKS):
        journal.append(ExecutedTick(step, 1, now, now, index, "policy", position, position, position))


def main(path: str, count: str, folder: str) -> None:
    """Record an episode of `count` frames from `path` in `folder`, publish it, and print the cost."""
    root = Path(folder)
    journal = EpisodeJournal(root / "episodes", RecordingSettings(min_free_bytes=0))
    journal.begin(header := manifest())
    fed = feed_frames(
        Frames(Path(path)), int(count), lambda index, pictures: append(journal, index, pictures)
    )
    closed: list[float] = []

    def save() -> None:
        begun = time.monotonic()
        journal.end(Outcome("finished", "the frames have ended", time.time()))
        closed.append(time.monotonic() - begun)
        publish(root / "episodes" / header["uuid"], root / "dataset")

    written = finish(fed, save, root / "dataset")
    outcome = json.loads((root / "episodes" / header["uuid"] / "outcome.json").read_text("utf-8"))
    lost = sum(outcome["repeated"].values()) + 3 * (int(count) - outcome["frames"])
    print(json.dumps({**written.fields(), "closed_s": closed[0], "lost": lost}))


if __name__ == "__main__":
    main(*sys.argv[1:])
