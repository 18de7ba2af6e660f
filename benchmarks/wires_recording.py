"""Recording to play: a LeRobot v2.1 dataset of one episode, whose videos are also played by file cameras."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from robots import Robot
from runtime.datasets.mapping import video_key
from runtime.simulation.bench.numbered_frames import Scene

_DATA = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
_VIDEO = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"


def record(root: Path, robot: Robot, frames: int, fps: int, height: int, width: int) -> dict[str, Path]:
    """Write the dataset; return the videos by camera key."""
    joints = np.repeat(robot.poses["home"][None], frames, axis=0).astype(np.float32)
    names = {"observation.state": joints, "action": joints}
    table = {name: pa.array(list(rows), pa.list_(pa.float32())) for name, rows in names.items()}
    table["timestamp"] = pa.array((np.arange(frames) / fps).astype(np.float32))
    table["frame_index"] = pa.array(np.arange(frames))
    table["episode_index"] = table["task_index"] = pa.array(np.zeros(frames, np.int64))
    table["index"] = table["frame_index"]
    data = root / _DATA.format(episode_chunk=0, episode_index=0)
    data.parent.mkdir(parents=True)
    pq.write_table(pa.table(table), data)
    videos = {
        camera.key: root / _VIDEO.format(episode_chunk=0, episode_index=0, video_key=video_key(camera.key))
        for camera in robot.cameras
    }
    _write_videos(videos, robot, frames, fps, height, width)
    _write_meta(root, robot, frames, fps, [height, width, 3])
    return videos


def _write_videos(
    videos: dict[str, Path], robot: Robot, frames: int, fps: int, height: int, width: int
) -> None:
    scene, joints = Scene(robot, height, width), robot.poses["home"]
    first = next(iter(videos))
    videos[first].parent.mkdir(parents=True)
    with av.open(str(videos[first]), "w") as container:
        stream = container.add_stream("libx264", rate=fps)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"crf": "23", "g": "2", "preset": "veryfast"}  # key frames as in LeRobot
        for number in range(frames):
            drawn = scene.draw(number, number / fps, joints)[first]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(drawn, format="bgr24")))
        container.mux(stream.encode())
    for path in videos.values():
        if path != videos[first]:
            path.parent.mkdir(parents=True)
            shutil.copyfile(videos[first], path)


def _write_meta(root: Path, robot: Robot, frames: int, fps: int, shape: list[int]) -> None:
    vector = {"dtype": "float32", "shape": [robot.dim], "names": list(robot.joint_names)}
    features: dict[str, object] = {"observation.state": vector, "action": vector}
    for camera in robot.cameras:
        features[video_key(camera.key)] = {
            "dtype": "video",
            "shape": shape,
            "names": ["height", "width", "channels"],
        }
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    for name in ("frame_index", "episode_index", "index", "task_index"):
        features[name] = {"dtype": "int64", "shape": [1], "names": None}
    info = {
        "codebase_version": "v2.1",
        "robot_type": robot.name,
        "total_episodes": 1,
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": 1000,
        "fps": fps,
        "splits": {"train": "0:1"},
        "data_path": _DATA,
        "video_path": _VIDEO,
        "features": features,
    }
    meta = root / "meta"
    meta.mkdir()
    (meta / "info.json").write_text(json.dumps(info), "utf-8")
    (meta / "episodes.jsonl").write_text(
        json.dumps({"episode_index": 0, "tasks": ["stand"], "length": frames}) + "\n", "utf-8"
    )
    (meta / "tasks.jsonl").write_text(json.dumps({"task_index": 0, "task": "stand"}) + "\n", "utf-8")
