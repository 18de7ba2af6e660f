"""The folder of a LeRobot v2.x dataset: its metadata files, and where an episode's data and videos lie."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from runtime.errors import RecordingError

CODEBASE_VERSION = "v2.1"
READABLE_VERSIONS = ("v2.0", "v2.1")
CHUNKS_SIZE = 1000  # episodes per chunk folder
DATA_PATH = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
VIDEO_PATH = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"

INFO = "meta/info.json"
EPISODES = "meta/episodes.jsonl"
TASKS = "meta/tasks.jsonl"
EPISODES_STATS = "meta/episodes_stats.jsonl"
STATS = "meta/stats.json"
MODALITY = "meta/modality.json"
EVA_EPISODES = "meta/eva_episodes.jsonl"

Info = Mapping[str, Any]


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in `path`; raises RecordingError where there is none."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise RecordingError(f"{path} does not exist") from None
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path} cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise RecordingError(f"{path} holds {type(content).__name__}, expected a JSON object")
    return content


def read_lines(path: Path) -> list[dict[str, Any]]:
    """The objects of a JSON Lines file, [] where it is absent; raises RecordingError naming a broken line."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return []
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path} cannot be read: {error}") from error
    lines = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        try:
            content = json.loads(line)
        except ValueError as error:
            raise RecordingError(f"{path}, line {number} is no JSON: {error}") from error
        if not isinstance(content, dict):
            raise RecordingError(f"{path}, line {number} holds {type(content).__name__}, expected an object")
        lines.append(content)
    return lines


def read_info(root: Path) -> dict[str, Any]:
    """meta/info.json of a v2.x dataset; raises RecordingError where the folder holds anything else."""
    info = read_json(root / INFO)
    version = info.get("codebase_version")
    if version not in READABLE_VERSIONS:
        raise RecordingError(f"{root} is a dataset of version {version!r}, readable are {READABLE_VERSIONS}")
    missing = [key for key in ("fps", "features", "total_episodes") if key not in info]
    if missing:
        raise RecordingError(f"{root / INFO} lacks {missing}, it has {sorted(info)}")
    fps = info["fps"]
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not 0 < fps < float("inf"):
        raise RecordingError(f"{root / INFO} gives fps {fps!r}, expected a positive number")
    return info


def data_file(root: Path, info: Info, index: int, stem: str | None = None) -> Path:
    """The parquet file of episode `index`."""
    return _resolve(root, info.get("data_path") or DATA_PATH, info, index, stem, "")


def video_file(root: Path, info: Info, key: str, index: int, stem: str | None = None) -> Path:
    """The mp4 file of video `key` of episode `index`."""
    return _resolve(root, info.get("video_path") or VIDEO_PATH, info, index, stem, key)


def _resolve(root: Path, template: str, info: Info, index: int, stem: str | None, key: str) -> Path:
    try:
        relative = template.format(
            episode_chunk=index // int(info.get("chunks_size") or CHUNKS_SIZE),
            episode_index=index,
            episode_file=stem or f"episode_{index:06d}",
            video_key=key,
        )
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise RecordingError(
            f"{root / INFO}: the path template {template!r} is unusable: {error!r}"
        ) from error
    if Path(relative).is_absolute() or ".." in Path(relative).parts:
        raise RecordingError(f"{root / INFO}: the path template {template!r} leads out of the dataset")
    return root / relative


def video_keys(features: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The keys of all features that are stored as videos."""
    return [key for key, feature in features.items() if feature.get("dtype") == "video"]
