"""Built episodes for the checks: a good one, in which an arm moves before cameras, and whatever a test spoils of it."""

from __future__ import annotations

import functools
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import robots
from runtime.recording.base import Outcome, Row
from runtime.recording.episode import EpisodeJournal
from runtime.recording.settings import RecordingSettings

HEIGHT, WIDTH = 192, 256
CAMERAS = ("cam_high", "cam_wrist")
FPS = 30.0
FRAMES = 90
LAG = 3  # rows by which the state follows the action
JOINTS = (*(f"arm.joint{n}" for n in range(1, 4)), "arm.gripper")
POSE = ("x", "y", "z", "qw", "qx", "qy", "qz", "gripper")
STARTED = 50.0

Spoil = Callable[[int, dict[str, Any]], None]


def manifest(**changes: Any) -> dict[str, Any]:
    return {
        "format": 1,
        "uuid": str(uuid.uuid4()),
        "station": "bench",
        "robot": {
            "name": "built",
            "joint_names": list(JOINTS),
            "eef_names": [f"arm.{field}" for field in POSE],
            "dim": len(JOINTS),
            "eef_dim": len(POSE),
        },
        "fps": FPS,
        "control_rate": FPS,
        "cameras": {camera: {"width": WIDTH, "height": HEIGHT} for camera in CAMERAS},
        "streams": {"qvel": True, "effort": False, "eef": True, "eef_action": False},
        "capture_streams": ["joints", *CAMERAS],
        "task": "stack the cups",
        "mode": "continuous",
        "strategy": "async",
        "kind": "rollout",
        "started_wall": 1.7e9,
        "started_monotonic": STARTED,
        "configuration": {},
        "configuration_hash": "abc",
        "versions": {},
    } | changes


def wanted(index: float) -> np.ndarray:
    """What is commanded at row `index`: a wave of the joints, a gripper that closes half way."""
    phase = index / FPS
    return np.array(
        [
            0.5 * np.sin(2 * phase),
            0.4 * np.cos(1.5 * phase),
            0.3 * np.sin(phase),
            0.04 if phase < 1.5 else 0.0,
        ],
        np.float32,
    )


@functools.cache
def _background(seed: int) -> np.ndarray:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    grey: np.ndarray = 60 + 30 * np.sin(x / 40.0 + seed) + 30 * np.cos(y / 30.0)
    return grey.astype(np.uint8)


def picture(index: int, seed: int = 0) -> np.ndarray:
    """A scene in which a block moves, in front of a pattern."""
    grey = _background(seed).copy()
    left = (8 * index + 16 * seed) % (WIDTH - 64)
    grey[48:128, left : left + 64] = 220
    return np.repeat(grey[:, :, None], 3, axis=2)


def fields(index: int) -> dict[str, Any]:
    """A good row."""
    time = STARTED + 0.5 + index / FPS
    pose = np.array([0.3 + 0.001 * index, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0, 0.04], np.float32)
    return {
        "index": index,
        "step": index,
        "tick_time": time,
        "sequence": index + 1,
        "qpos": wanted(index - LAG),
        "action": wanted(index),
        "qvel": np.zeros(len(JOINTS), np.float32),
        "eef": pose,
        "eef_measured": True,
        "captured": {"joints": time - 0.002, "cam_high": time - 0.02, "cam_wrist": time - 0.01},
        "pictures": {camera: picture(index, seed) for seed, camera in enumerate(CAMERAS)},
        "control_source": "policy",
    }


def record(
    root: Path, spoil: Spoil | None = None, frames: int = FRAMES, status: Any = "finished", **changes: Any
) -> Path:
    """The episode with each row as `spoil` leaves it; `changes` are keys of the manifest."""
    told = manifest(**changes)
    journal = EpisodeJournal(
        root, RecordingSettings(min_free_bytes=0, queue_frames=64, flush_period_s=0.05), patient=True
    )
    journal.begin(told)
    for index in range(frames):
        row = fields(index)
        if spoil is not None:
            spoil(index, row)
        row["pictures"] = {
            camera: shot for camera, shot in row["pictures"].items() if camera in told["cameras"]
        }
        journal.append(Row(**row))
    journal.end(Outcome(status, "the operator said so", 1.7e9 + frames / FPS))
    return root / str(told["uuid"])


def at(frames: range, **changes: Any) -> Spoil:
    """Fields of some rows; a callable is given the field as it was."""

    def spoil(index: int, row: dict[str, Any]) -> None:
        if index in frames:
            for name, change in changes.items():
                row[name] = change(row[name]) if callable(change) else change

    return spoil


def shown(frames: range, make: Callable[[int], np.ndarray | None], camera: str = "cam_high") -> Spoil:
    """Other pictures of one camera."""

    def spoil(index: int, row: dict[str, Any]) -> None:
        if index in frames:
            row["pictures"] = {**row["pictures"], camera: make(index)}

    return spoil


def late(streams: Mapping[str, float], frames: range) -> Spoil:
    """Streams captured that much earlier [s]."""

    def spoil(index: int, row: dict[str, Any]) -> None:
        if index in frames:
            row["captured"] = {name: time - streams.get(name, 0.0) for name, time in row["captured"].items()}

    return spoil


def record_of(
    root: Path, name: str, spoil: Spoil | None = None, frames: int = FRAMES, **changes: Any
) -> Path:
    """The same by a robot that is described here, with its cameras; two of its joints move."""
    robot = robots.load_robot(name)
    keys = [camera.key for camera in robot.cameras]
    rest = next(iter(robot.poses.values())).astype(np.float32)

    def fit(index: int, row: dict[str, Any]) -> None:
        for column, moment in (("qpos", index - LAG), ("action", index)):
            row[column] = rest.copy()
            row[column][[0, 7]] += 0.3 * np.sin(np.array([moment / 20, moment / 15]))
        row["qvel"], row["eef"] = np.zeros(robot.dim, np.float32), None
        row["pictures"] = {key: picture(index, seed) for seed, key in enumerate(keys)}
        row["captured"] = {"joints": row["captured"]["joints"]} | dict.fromkeys(
            keys, row["captured"]["cam_wrist"]
        )
        if spoil is not None:
            spoil(index, row)

    described = {
        "name": name,
        "joint_names": list(robot.joint_names),
        "eef_names": list(robot.eef_names),
        "dim": robot.dim,
        "eef_dim": robot.eef_dim,
    }
    return record(
        root,
        fit,
        frames,
        robot=described,
        cameras={key: {"width": WIDTH, "height": HEIGHT} for key in keys},
        streams={"qvel": True, "effort": False, "eef": False, "eef_action": False},
        capture_streams=["joints", *keys],
        **changes,
    )
