"""Small episodes for tests: every picture shows its own number, so a frame proves which row it belongs to."""

from __future__ import annotations

import json
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import av
import numpy as np

from runtime.ipc.messages import ExecutedTick
from runtime.recording.base import RawChunk, Row
from runtime.recording.layout import Layout
from runtime.recording.outcome_seal import (
    OUTCOME,
    OUTCOME_COPY,
    digests_of,
    seal_outcome,
    without_digests,
    write_outcome,
)
from runtime.recording.settings import RecordingSettings
from tests.processes import PATIENCE_S

HEIGHT, WIDTH = 48, 64
DIM, EEF_DIM = 3, 8
STARTED = 1000.0
CAMERAS = ("observation.images.front", "observation.images.wrist")
BITS = 16

SETTINGS = RecordingSettings(
    min_free_bytes=0, queue_frames=64, flush_period_s=0.05, max_lag_s=10.0, drain_timeout_s=PATIENCE_S
)


def manifest(**changes: Any) -> dict[str, Any]:
    """A whole manifest of a robot with three joints and two cameras."""
    return {
        "format": 1,
        "uuid": str(uuid.uuid4()),
        "station": "bench",
        "robot": {
            "name": "toy",
            "joint_names": [f"arm.joint{i}" for i in range(DIM)],
            "eef_names": [f"arm.pose{i}" for i in range(EEF_DIM)],
            "dim": DIM,
            "eef_dim": EEF_DIM,
        },
        "fps": 30.0,
        "control_rate": 100.0,
        "cameras": {camera: {"width": WIDTH, "height": HEIGHT} for camera in CAMERAS},
        "streams": {"qvel": True, "effort": False, "eef": True, "eef_action": True},
        "capture_streams": ["joints", *CAMERAS],
        "task": "stack the blocks",
        "mode": "continuous",
        "strategy": "async",
        "kind": "rollout",
        "started_wall": 1.7e9,
        "started_monotonic": STARTED,
        "configuration": {},
        "configuration_hash": "0",
        "versions": {},
        **changes,
    }


def numbered(number: int) -> np.ndarray:
    """A picture that shows `number` as 16 black or white blocks."""
    bits = (number >> np.arange(BITS)) & 1
    blocks = np.kron(
        bits.reshape(4, 4).astype(np.uint8) * 200 + 20, np.ones((HEIGHT // 4, WIDTH // 4), np.uint8)
    )
    return np.repeat(blocks[:, :, None], 3, axis=2)


def number_of(picture: np.ndarray) -> int:
    """The number that a decoded picture shows."""
    blocks = picture[:, :, 1].reshape(4, HEIGHT // 4, 4, WIDTH // 4).mean(axis=(1, 3)).ravel()
    return int(((blocks > 120) << np.arange(BITS)).sum())


def decoded(path: Path) -> list[np.ndarray]:
    """All frames of a video as RGB."""
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def numbers(path: Path) -> list[int]:
    """The number that each frame of a video shows."""
    return [number_of(picture) for picture in decoded(path)]


def row(index: int, pictures: Mapping[str, np.ndarray | None] | None = None, **changes: Any) -> Row:
    """Row `index`, whose pictures show `index` + 1 and whose vectors hold `index`."""
    time = STARTED + index / 30.0
    fields: dict[str, Any] = {
        "index": index,
        "step": 3 * index,
        "tick_time": time,
        "sequence": index,
        "qpos": np.full(DIM, index, np.float32),
        "action": np.full(DIM, index + 0.5, np.float32),
        "captured": {"joints": time - 0.01, CAMERAS[0]: time - 0.03, CAMERAS[1]: time - 0.02},
        "pictures": {camera: numbered(index + 1) for camera in CAMERAS} if pictures is None else pictures,
        "control_source": "policy",
        "qvel": np.zeros(DIM, np.float32),
        "eef": np.zeros(EEF_DIM, np.float32),
        "eef_action": np.ones(EEF_DIM, np.float32),
        "eef_measured": True,
    }
    return Row(**{**fields, **changes})


def tick(step: int, **changes: Any) -> ExecutedTick:
    """A control tick at 100 Hz in which safety limited the speed."""
    planned = STARTED + step / 100.0
    fields: dict[str, Any] = {
        "step": step,
        "run": 1,
        "planned": planned,
        "sent": planned + 0.001,
        "sequence": step // 3,
        "source": "policy",
        "qpos": np.full(DIM, step, np.float32),
        "smoothed": np.full(DIM, step + 0.25, np.float32),
        "executed": np.full(DIM, step + 0.5, np.float32),
        "chunk_ids": [4, 5],
        "weights": [0.25, 0.75],
        "notes": ["speed"],
    }
    return ExecutedTick(**{**fields, **changes})


def chunk(chunk_id: int, horizon: int = 4, width: int = 2) -> RawChunk:
    """An answer of a policy whose first row came too late."""
    targets = np.arange(10, 10 + horizon, dtype=np.int64)
    targets[0] = -1
    actions = np.arange(horizon * width, dtype=np.float32).reshape(horizon, width)
    return RawChunk(chunk_id, 10, 11, actions, targets, "joint", 1, 0, 42.5)


def unsealed(folder: Path, **changes: object) -> None:
    """Make the outcome one from before there were digests and copies of it, with `changes`."""
    path = folder / "outcome.json"
    (folder / OUTCOME_COPY).unlink(missing_ok=True)
    path.write_text(json.dumps(without_digests(json.loads(path.read_text())) | changes))


def unended(folder: Path) -> None:
    """Take its outcome and the copy of that away, as if the recorder had been killed just before it wrote them."""
    for name in (OUTCOME_COPY, OUTCOME):
        (folder / name).unlink()


def resealed(folder: Path, **changes: object) -> None:
    """Give an episode whose files a test has changed the digests of these, as if it had been recorded so."""
    path = folder / "outcome.json"
    outcome = without_digests(json.loads(path.read_text())) | changes
    layout = Layout.from_manifest(json.loads((folder / "manifest.json").read_text()))
    write_outcome(folder, seal_outcome(outcome, digests_of(folder, layout)))
