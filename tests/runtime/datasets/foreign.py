"""Datasets of another program, in every version of the format, written from its description alone."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from av.video.frame import PictureType
from PIL import Image

from tests.runtime.datasets.small import HEIGHT, JOINTS, POSES, WIDTH, picture, vectors

WIDTHS = {
    "observation.state": len(JOINTS),
    "observation.eef": len(POSES),
    "action": len(JOINTS),
    "action_eef": len(POSES),
}
MOST = 40  # pictures that can be told apart


@dataclass(frozen=True)
class Plan:
    """What to write. In v3.0 `per_data` and `per_video` episodes share a file, `per_chunk` files a folder."""

    version: str = "v3.0"
    lengths: tuple[int, ...] = (7, 5, 9)
    fps: float = 10.0
    videos: tuple[str, ...] = ("cam_high", "cam_wrist")
    images: tuple[str, ...] = ()
    per_data: int = 2
    per_video: int = 3
    per_chunk: int = 1000
    groups: bool = True  # whether each episode is a row group of its own
    gop: int = 250
    b_frames: int = 3
    key_frames: bool = True  # whether each episode begins with a key frame
    widths: Mapping[str, int] = field(default_factory=lambda: WIDTHS)
    names: Mapping[str, Sequence[str]] = field(default_factory=dict)  # of the numbers of some columns
    smooth: bool = False  # motion that a robot could make; else noise

    @property
    def firsts(self) -> list[int]:
        return [sum(self.lengths[:k]) for k in range(len(self.lengths))]


def shown(index: int, frame: int) -> int:
    """The number in picture `frame` of episode `index`: neighbours of other episodes differ."""
    return (7 * index + frame) % MOST


def column(index: int, name: str, length: int, plan: Plan | None = None) -> np.ndarray:
    widths = plan.widths if plan else WIDTHS
    if plan and plan.smooth:
        phase = np.arange(length)[:, None] / 20 + index + list(widths).index(name) / 10
        return (0.02 * (1 + np.sin(phase + np.arange(widths[name])))).astype(np.float32)
    return vectors(length, widths[name], 10 * index + list(widths).index(name))


def write(root: Path, plan: Plan) -> None:
    v30 = plan.version == "v3.0"
    (root / "meta").mkdir(parents=True)
    if v30:
        _rows_v30(root, plan)
    else:
        for index in range(len(plan.lengths)):
            path = root / f"data/chunk-000/episode_{index:06d}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            pq.write_table(_table(plan, index), path)
    for key in plan.videos:
        groups = _together(len(plan.lengths), plan.per_video) if v30 else _together(len(plan.lengths), 1)
        for number, episodes in enumerate(groups):
            chunk, file = divmod(number, plan.per_chunk)
            name = (
                f"videos/observation.images.{key}/chunk-{chunk:03d}/file-{file:03d}.mp4"
                if v30
                else f"videos/chunk-000/observation.images.{key}/episode_{number:06d}.mp4"
            )
            _video(root / name, plan, episodes)
    (_meta_v30 if v30 else _meta_v2)(root, plan)


def _together(count: int, size: int) -> list[list[int]]:
    return [list(range(first, min(first + size, count))) for first in range(0, count, size)]


def _png(number: int) -> bytes:
    sink = io.BytesIO()
    Image.fromarray(picture(number)).save(sink, "PNG")
    return sink.getvalue()


def _table(plan: Plan, index: int) -> pa.Table:
    length, frames = plan.lengths[index], np.arange(plan.lengths[index])
    made: dict[str, Any] = {
        name: pa.array(list(column(index, name, length, plan)), pa.list_(pa.float32(), width))
        for name, width in plan.widths.items()
    }
    for key in plan.images:
        made[f"observation.images.{key}"] = pa.array(
            [{"bytes": _png(shown(index, k)), "path": f"frame_{k:06d}.png"} for k in range(length)],
            pa.struct({"bytes": pa.binary(), "path": pa.string()}),
        )
    made["timestamp"] = pa.array((frames / plan.fps).astype(np.float32))
    made["frame_index"] = pa.array(frames)
    made["episode_index"] = pa.array(np.full(length, index))
    made["index"] = pa.array(frames + plan.firsts[index])
    made["task_index"] = pa.array(np.full(length, index % 2))
    return pa.table(made)


def _rows_v30(root: Path, plan: Plan) -> None:
    for number, episodes in enumerate(_together(len(plan.lengths), plan.per_data)):
        chunk, file = divmod(number, plan.per_chunk)
        path = root / f"data/chunk-{chunk:03d}/file-{file:03d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        tables = [_table(plan, index) for index in episodes]
        with pq.ParquetWriter(path, tables[0].schema) as writer:
            for table in tables if plan.groups else [pa.concat_tables(tables)]:
                writer.write_table(table)


def _video(path: Path, plan: Plan, episodes: Sequence[int]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(plan.fps).limit_denominator(1000))
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.options = {
            "crf": "5",
            "g": str(plan.gop),
            "bf": str(plan.b_frames),
            "b-adapt": "0",
            "sc_threshold": "0",
            "forced-idr": "1",
        }
        for index in episodes:
            for frame in range(plan.lengths[index]):
                coded = av.VideoFrame.from_ndarray(picture(shown(index, frame)), format="rgb24")
                if frame == 0 and plan.key_frames:
                    coded.pict_type = PictureType.I
                container.mux(stream.encode(coded))
        container.mux(stream.encode())


def _info(plan: Plan) -> dict[str, Any]:
    features: dict[str, Any] = {
        name: {"dtype": "float32", "shape": [width], "names": plan.names.get(name)}
        for name, width in plan.widths.items()
    }
    for keys, dtype in ((plan.videos, "video"), (plan.images, "image")):
        for key in keys:
            names = ["height", "width", "channels"]
            features[f"observation.images.{key}"] = {
                "dtype": dtype,
                "shape": [HEIGHT, WIDTH, 3],
                "names": names,
            }
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    for name in ("frame_index", "episode_index", "index", "task_index"):
        features[name] = {"dtype": "int64", "shape": [1], "names": None}
    return {
        "codebase_version": plan.version,
        "robot_type": "small",
        "total_episodes": len(plan.lengths),
        "total_frames": sum(plan.lengths),
        "total_tasks": 2,
        "chunks_size": 1000 if plan.version != "v3.0" else plan.per_chunk,
        "fps": plan.fps,
        "splits": {"train": f"0:{len(plan.lengths)}"},
        "features": features,
    }


def _statistics(plan: Plan, index: int) -> dict[str, Any]:
    """Of the vectors exactly, of the pictures from their numbers."""
    length = plan.lengths[index]
    made = {
        name: _figures(column(index, name, length, plan).astype(np.float64), (-1,)) for name in plan.widths
    }
    frames = np.arange(length, dtype=np.float64)
    for name, values in {
        "timestamp": (frames / plan.fps).astype(np.float32).astype(np.float64),
        "frame_index": frames,
        "episode_index": np.full(length, float(index)),
        "index": frames + plan.firsts[index],
        "task_index": np.full(length, float(index % 2)),
    }.items():
        made[name] = _figures(values.reshape(-1, 1), (-1,))
    for key in (*plan.videos, *plan.images):
        grey = np.array([[picture(shown(index, k))[0, 0, 0] / 255] * 3 for k in range(length)])
        made[f"observation.images.{key}"] = _figures(grey, (3, 1, 1))
    return made


def _figures(values: np.ndarray, shape: tuple[int, ...]) -> dict[str, Any]:
    made = {
        name: getattr(values, name)(axis=0).reshape(shape).tolist() for name in ("min", "max", "mean", "std")
    }
    return made | {"count": [len(values)]}


def _jsonl(path: Path, lines: Iterator[dict[str, Any]]) -> None:
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


def _meta_v2(root: Path, plan: Plan) -> None:
    count = len(plan.lengths)
    info = _info(plan) | {
        "total_videos": count * len(plan.videos),
        "total_chunks": 1,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
    }
    meta = root / "meta"
    (meta / "info.json").write_text(json.dumps(info))
    _jsonl(meta / "tasks.jsonl", ({"task_index": n, "task": f"task {n}"} for n in (0, 1)))
    episodes = (
        {"episode_index": k, "tasks": [f"task {k % 2}"], "length": plan.lengths[k]} for k in range(count)
    )
    _jsonl(meta / "episodes.jsonl", episodes)
    if plan.version == "v2.0":
        (meta / "stats.json").write_text(json.dumps(_statistics(plan, 0)))
    else:
        stats = ({"episode_index": k, "stats": _statistics(plan, k)} for k in range(count))
        _jsonl(meta / "episodes_stats.jsonl", stats)


def _meta_v30(root: Path, plan: Plan) -> None:
    info = _info(plan) | {
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    }
    meta = root / "meta"
    (meta / "info.json").write_text(json.dumps(info))
    (meta / "stats.json").write_text(json.dumps(_statistics(plan, 0)))
    tasks = pa.table({"task_index": [0, 1], "__index_level_0__": ["task 0", "task 1"]})
    pq.write_table(tasks, meta / "tasks.parquet")
    (meta / "episodes/chunk-000").mkdir(parents=True)
    rows = [_row_v30(plan, index) for index in range(len(plan.lengths))]
    for number, part in enumerate((rows[:2], rows[2:])):
        if part:
            pq.write_table(pa.Table.from_pylist(part), meta / f"episodes/chunk-000/file-{number:03d}.parquet")


def _row_v30(plan: Plan, index: int) -> dict[str, Any]:
    data_chunk, data_file = divmod(index // plan.per_data, plan.per_chunk)
    video_chunk, video_file = divmod(index // plan.per_video, plan.per_chunk)
    start = sum(plan.lengths[index // plan.per_video * plan.per_video : index]) / plan.fps
    row: dict[str, Any] = {
        "episode_index": index,
        "tasks": [f"task {index % 2}"],
        "length": plan.lengths[index],
        "data/chunk_index": data_chunk,
        "data/file_index": data_file,
        "dataset_from_index": plan.firsts[index],
        "dataset_to_index": plan.firsts[index] + plan.lengths[index],
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0 if index < 2 else 1,
    }
    for key in plan.videos:
        name = f"videos/observation.images.{key}"
        row |= {
            f"{name}/chunk_index": video_chunk,
            f"{name}/file_index": video_file,
            f"{name}/from_timestamp": start,
            f"{name}/to_timestamp": start + plan.lengths[index] / plan.fps,
        }
    for feature, statistic in _statistics(plan, index).items():
        row |= {f"stats/{feature}/{figure}": value for figure, value in statistic.items()}
    return row
