"""Folder of a LeRobot dataset: the names of its files, and functions that read them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from runtime.core.errors import RecordingError

V20, V21, V30 = "v2.0", "v2.1", "v3.0"
READABLE_VERSIONS = (V20, V21, V30)
WRITABLE_VERSIONS = (V21, V30)
DEFAULT_VERSION = V21  # read by openpi, GR00T and StarVLA; LeRobot reads only v3.0 since 0.4

CHUNKS_SIZE = 1000  # episodes (v2.x) or files (v3.0) per chunk folder
DATA_PATH = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
VIDEO_PATH = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
DATA_PATH_V30 = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH_V30 = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"

INFO = "meta/info.json"
EPISODES = "meta/episodes.jsonl"  # v2.x
TASKS = "meta/tasks.jsonl"  # v2.x
EPISODES_STATS = "meta/episodes_stats.jsonl"  # v2.1
EPISODES_V30 = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
TASKS_V30 = "meta/tasks.parquet"
STATS = "meta/stats.json"
MODALITY = "meta/modality.json"
EVA_EPISODES = "meta/eva_episodes.jsonl"
SUBSET = "meta/eva_subset.json"  # how the episodes were chosen
PUBLISHING = ".publishing"  # hidden, and outside data/, where readers open every file
PUBLISHING_PLAN = f"{PUBLISHING}/plan.json"

COUNTED = ("total_episodes", "total_frames", "total_tasks", "total_videos", "total_chunks", "splits")
INFO_KEYS = frozenset(  # of any version
    (
        *COUNTED,
        *("codebase_version", "robot_type", "fps", "features", "data_path", "video_path"),
        *("chunks_size", "data_files_size_in_mb", "video_files_size_in_mb"),
    )
)

Info = Mapping[str, Any]
Line = dict[str, Any]  # entry of a metadata list, for one episode or task


def read_json(path: Path) -> dict[str, Any]:
    """Return the JSON object in `path`. Raises: RecordingError if there is no valid object."""
    try:
        content = _parse(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise RecordingError(f"{path} does not exist") from None
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path} cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise RecordingError(f"{path} holds {type(content).__name__}, expected a JSON object")
    return content


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Return the objects of a JSON Lines file, [] if there is no file. Raises: RecordingError, which names an invalid
    line.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return []
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path} cannot be read: {error}") from error
    lines = []
    for number, line in enumerate(text.split("\n"), start=1):
        if not line.strip():
            continue
        try:
            content = _parse(line)
        except ValueError as error:
            raise RecordingError(f"{path}, line {number} is no JSON: {error}") from error
        if not isinstance(content, dict):
            raise RecordingError(f"{path}, line {number} holds {type(content).__name__}, expected an object")
        lines.append(content)
    return lines


def _parse(text: str) -> Any:
    """Return the parsed JSON. Raises: ValueError for a duplicate key, because readers differ in which value
    they use.
    """
    try:
        return json.loads(text, object_pairs_hook=_unique)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def _unique(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    fields = dict(pairs)
    if len(fields) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"it gives {next(key for key in keys if keys.count(key) > 1)!r} twice")
    return fields


def read_info(root: Path) -> dict[str, Any]:
    """Return meta/info.json of a readable dataset. Raises: RecordingError if the folder does not contain one."""
    info = read_json(root / INFO)
    version = info.get("codebase_version")
    if version not in READABLE_VERSIONS:
        raise RecordingError(f"{root} is a dataset of version {version!r}, readable are {READABLE_VERSIONS}")
    missing = [key for key in ("fps", "features", "total_episodes") if key not in info]
    if missing:
        raise RecordingError(f"{root / INFO} lacks {missing}, it has {sorted(info)}")
    fps, features, splits = info["fps"], info["features"], info.get("splits")
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not 0 < fps < float("inf"):
        raise RecordingError(f"{root / INFO} gives fps {fps!r}, expected a positive number")
    for key, least in (("total_episodes", 0), ("chunks_size", 1)):
        if not _is_count(info.get(key, least), least):
            raise RecordingError(
                f"{root / INFO} gives {key} {info[key]!r}, expected a whole number from {least} on"
            )
    if not isinstance(features, dict) or not (splits is None or isinstance(splits, dict)):
        raise RecordingError(
            f"{root / INFO}: features and splits are JSON objects, these are {features!r:.80}, {splits!r:.80}"
        )
    for key, feature in features.items():
        if not _declares(feature):
            raise RecordingError(
                f"{root / INFO}: feature {key!r} is {feature!r:.120}, expected an object with dtype and shape (lengths)"
            )
    return info


def _is_count(value: object, least: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= least


def _declares(feature: object) -> bool:
    """Return True if the feature is an object with a dtype and the lengths of its axes."""
    if not isinstance(feature, dict) or not isinstance(feature.get("dtype"), str):
        return False
    shape = feature.get("shape")
    return isinstance(shape, list) and all(_is_count(length, 0) for length in shape)


def resolve(root: Path, template: str, **fields: Any) -> Path:
    """Return the file for a path template of info.json. Raises: RecordingError if it would be outside `root`."""
    try:
        relative = template.format(**fields)
    except (KeyError, IndexError, ValueError, TypeError, AttributeError) as error:
        raise RecordingError(
            f"{root / INFO}: the path template {template!r} is unusable: {error!r}"
        ) from error
    if Path(relative).is_absolute() or ".." in Path(relative).parts:
        raise RecordingError(f"{root / INFO}: the path template {template!r} leads out of the dataset")
    return root / relative


def video_keys(features: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the keys of all features stored as videos."""
    return [key for key, feature in features.items() if feature.get("dtype") == "video"]


def image_keys(features: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the keys of all features stored as images in a column."""
    return [key for key, feature in features.items() if feature.get("dtype") == "image"]
