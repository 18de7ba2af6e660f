"""Small datasets, episodes and robots that the tests make; picture k of a video shows its number."""

from __future__ import annotations

import json
import uuid
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from runtime.recording.base import Outcome, Row
from runtime.recording.episode import EpisodeJournal
from runtime.recording.settings import RecordingSettings

HEIGHT, WIDTH = 48, 64
CAMERAS = ("cam_high", "cam_wrist")
JOINTS = tuple(f"{arm}_arm.joint{n}" for arm in ("left", "right") for n in range(3))
POSES = tuple(
    f"{arm}_arm.{field}"
    for arm in ("left", "right")
    for field in ("x", "y", "z", "qw", "qx", "qy", "qz", "gripper")
)


def robot(cameras: tuple[str, ...] = CAMERAS, dim: int = len(JOINTS)) -> Any:
    """As much of a robot description as a dataset needs."""
    arms = tuple(
        SimpleNamespace(name=f"{side}_arm", gripper=None, gripper_dim=None, chain=True)
        for side in ("left", "right")
    )
    return SimpleNamespace(
        name="small",
        dim=dim,
        joint_names=JOINTS,
        arms=arms,
        groups=arms,
        cameras=tuple(SimpleNamespace(name=key, key=key) for key in cameras),
    )


def picture(number: int) -> np.ndarray:
    """A grey picture that survives coding; `seen` reads its number back."""
    return np.full((HEIGHT, WIDTH, 3), 30 + 5 * number, dtype=np.uint8)


def seen(pixels: np.ndarray) -> int:
    return round((float(pixels.mean()) - 30) / 5)


def write_video(path: Path, frames: int, fps: float, gop: int = 250, b_frames: int = 3) -> None:
    """Hard to seek in: few key frames, B-frames, the index at the end of the file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000))
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.options = {"crf": "5", "g": str(gop), "bf": str(b_frames), "b-adapt": "0", "sc_threshold": "0"}
        for number in range(frames):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(number), format="rgb24")))
        container.mux(stream.encode())


def vectors(frames: int, width: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(frames, width)).astype(np.float32)


def write_dataset(
    root: Path,
    lengths: tuple[int, ...] = (12,),
    fps: float = 10.0,
    cameras: tuple[str, ...] = CAMERAS,
    chunks_size: int = 1000,
    gop: int = 250,
    names: dict[str, str] | None = None,
) -> dict[int, dict[str, np.ndarray]]:
    """A v2.1 dataset of another program; returns the columns by episode. `names` renames columns."""
    columns = {
        name: (names or {}).get(name, name)
        for name in ("observation.state", "observation.eef", "action", "action_eef")
    }
    widths = dict(zip(columns, (len(JOINTS), len(POSES), len(JOINTS), len(POSES)), strict=True))
    features: dict[str, Any] = {
        columns[name]: {"dtype": "float32", "shape": [width], "names": None} for name, width in widths.items()
    }
    features |= {
        f"observation.images.{camera}": {"dtype": "video", "shape": [HEIGHT, WIDTH, 3], "names": None}
        for camera in cameras
    }
    features |= {
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        "task_index": {"dtype": "int64", "shape": [1], "names": None},
    }
    written: dict[int, dict[str, np.ndarray]] = {}
    for index, length in enumerate(lengths):
        rows = {
            columns[name]: vectors(length, width, 10 * index + n)
            for n, (name, width) in enumerate(widths.items())
        }
        written[index] = rows
        table = {name: pa.array(list(value), pa.list_(pa.float32())) for name, value in rows.items()}
        table["timestamp"] = pa.array((np.arange(length) / fps).astype(np.float32))
        table["task_index"] = pa.array(np.full(length, index % 2))
        folder = root / f"data/part-{index // chunks_size:03d}"
        folder.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(table), folder / f"take_{index:06d}.parquet")
        for camera in cameras:
            video = f"films/part-{index // chunks_size:03d}/observation.images.{camera}/take_{index:06d}.mp4"
            write_video(root / video, length, fps, gop)
    _write_meta(root, lengths, fps, chunks_size, features)
    return written


def _write_meta(
    root: Path, lengths: tuple[int, ...], fps: float, chunks_size: int, features: dict[str, Any]
) -> None:
    info = {
        "codebase_version": "v2.1",
        "robot_type": "small",
        "total_episodes": len(lengths),
        "total_frames": sum(lengths),
        "chunks_size": chunks_size,
        "fps": fps,
        "data_path": "data/part-{episode_chunk:03d}/take_{episode_index:06d}.parquet",
        "video_path": "films/part-{episode_chunk:03d}/{video_key}/take_{episode_index:06d}.mp4",
        "features": features,
    }
    meta = root / "meta"
    meta.mkdir(parents=True, exist_ok=True)
    (meta / "info.json").write_text(json.dumps(info))
    episodes = [
        {"episode_index": index, "tasks": [f"task {index % 2}"], "length": length}
        for index, length in enumerate(lengths)
    ]
    (meta / "episodes.jsonl").write_text("".join(json.dumps(line) + "\n" for line in episodes))
    tasks = [{"task_index": number, "task": f"task {number}"} for number in (0, 1)]
    (meta / "tasks.jsonl").write_text("".join(json.dumps(line) + "\n" for line in tasks))


def manifest(**changes: Any) -> dict[str, Any]:
    """A manifest with every stream; `changes` replace top-level keys."""
    return {
        "format": 1,
        "uuid": str(uuid.uuid4()),
        "station": "bench",
        "robot": {
            "name": "small",
            "joint_names": list(JOINTS),
            "eef_names": list(POSES),
            "dim": len(JOINTS),
            "eef_dim": len(POSES),
        },
        "fps": 30.0,
        "control_rate": 30.0,
        "cameras": {camera: {"width": WIDTH, "height": HEIGHT} for camera in CAMERAS},
        "streams": {"qvel": True, "effort": True, "eef": True, "eef_action": True},
        "capture_streams": ["joints", "eef", *CAMERAS],
        "task": "stack the cups",
        "mode": "continuous",
        "strategy": "async",
        "kind": "rollout",
        "started_wall": 1.7e9,
        "started_monotonic": 50.0,
        "configuration": {},
        "configuration_hash": "abc",
        "versions": {"eva-web": "0"},
    } | changes


def row(index: int, seed: int = 0, **changes: Any) -> Row:
    """Row `index`, captured a little before its tick; the second camera's clock is unknown in row 1."""
    time = 50.5 + index / 30
    draw = np.random.default_rng(1000 * seed + index)
    captured = {
        "joints": time - 0.001,
        "eef": time - 0.002,
        "cam_high": time - 0.01,
        "cam_wrist": time - 0.02,
    }
    if index == 1:
        del captured["cam_wrist"]

    def vector(width: int) -> np.ndarray:
        return draw.normal(size=width).astype(np.float32)

    values: dict[str, Any] = {
        "index": index,
        "step": index,
        "tick_time": time,
        "sequence": index + 1,
        "qpos": vector(len(JOINTS)),
        "action": vector(len(JOINTS)),
        "qvel": vector(len(JOINTS)),
        "effort": vector(len(JOINTS)),
        "eef": vector(len(POSES)),
        "eef_action": vector(len(POSES)),
        "eef_measured": True,
        "eef_action_reported": index % 2 == 0,
        "captured": captured,
        "pictures": {camera: picture(index) for camera in CAMERAS},
        "control_source": "hold" if index == 0 else "policy",
    }
    return Row(**(values | changes))


def record(
    root: Path,
    frames: int = 20,
    seed: int = 0,
    status: Any = "finished",
    details: dict[str, object] | None = None,
    rows: dict[int, dict[str, Any]] | None = None,
    **changes: Any,
) -> Path:
    """A recorded episode; `rows` changes fields of single rows, `changes` keys of the manifest."""
    told = manifest(**changes)
    journal = EpisodeJournal(root, RecordingSettings(min_free_bytes=0), patient=True)
    journal.begin(told)
    for index in range(frames):
        change = (rows or {}).get(index, {})
        if told["cameras"].keys() != set(CAMERAS) and "pictures" not in change:
            change = change | {"pictures": {camera: picture(index) for camera in told["cameras"]}}
        journal.append(row(index, seed, **change))
    journal.end(Outcome(status, "the operator said so", 1.7e9 + frames / 30, details or {}))
    return root / str(told["uuid"])
