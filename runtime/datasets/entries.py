"""Episodes and tasks in the metadata of a dataset of any version."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from runtime.core.errors import RecordingError
from runtime.datasets import layout, parquet_lists
from runtime.datasets.layout import Info, Line


@dataclass(frozen=True, slots=True)
class Span:
    """Location of the images of one camera in one episode."""

    path: Path
    start: float | None = None  # time of the first image [s]; None: the file has only this episode


@dataclass(frozen=True, slots=True)
class EpisodeEntry:
    """One episode with its files, as the metadata list it."""

    index: int
    length: int  # rows
    tasks: tuple[str, ...]
    data: Path  # parquet
    shared: bool  # `data` also has rows of other episodes
    videos: Mapping[str, Span]  # by video key


def episode_lines(root: Path, info: Info) -> list[Line]:
    """Return the list of episodes as stored, ordered by index; indices may have gaps.

    An episode whose publication is in progress or was interrupted is excluded.

    Raises:
        RecordingError: The list does not have the episodes that info.json counts, so that some would be lost unnoticed.
    """
    v30 = info["codebase_version"] == layout.V30
    path = root / (parquet_lists.EPISODES_FOLDER if v30 else layout.EPISODES)
    lines = parquet_lists.read_episodes(root) if v30 else layout.read_lines(path)
    try:
        total, by_index = int(info["total_episodes"]), {int(line["episode_index"]): line for line in lines}
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(f"{path}: a line says no episode_index: {error!r}") from error
    if len(by_index) < len(lines):
        raise RecordingError(f"{path} lists an episode twice: {_brief([*map(_index, lines)])}")
    if (pending := publishing(root)) is not None and pending >= total:
        by_index.pop(pending, None)
    if len(by_index) != total:
        if int(layout.read_info(root)["total_episodes"]) == total:
            raise RecordingError(
                f"{path} lists {len(by_index)} episodes ({_brief(sorted(by_index))}), {layout.INFO} counts {total}: "
                "correct the one that is wrong"
            )
        by_index = {
            index: line for index, line in by_index.items() if index < total
        }  # published during the read
    return [by_index[index] for index in sorted(by_index)]


def of_episodes(lines: Iterable[Line], episodes: Iterable[Line]) -> list[Line]:
    """Return the lines that are about one of `episodes`, ordered by index."""
    listed = {_index(line) for line in episodes}
    return sorted((line for line in lines if _index(line) in listed), key=_index)


def _index(line: Line) -> int:
    return int(line["episode_index"])


def publishing(root: Path) -> int | None:
    """Return the index of the episode whose publication is in progress or was interrupted; None if there is none."""
    path = root / layout.PUBLISHING_PLAN
    try:
        index = layout.read_json(path).get("episode_index")
    except RecordingError:
        if path.exists():
            raise
        return None
    return index if isinstance(index, int) else None


def _brief(indices: list[int]) -> str:
    text = ", ".join(map(str, indices[:8]))
    return text if len(indices) <= 8 else f"{text}, ... {indices[-1]}"


def task_lines(root: Path, info: Info) -> list[Line]:
    """Return the list of tasks as {"task_index", "task"}, as stored."""
    if info["codebase_version"] == layout.V30:
        return parquet_lists.read_tasks(root)
    lines = layout.read_lines(root / layout.TASKS)
    for line in lines:
        if not isinstance(line.get("task_index"), int) or not isinstance(line.get("task"), str):
            raise RecordingError(f"{root / layout.TASKS}: {line} is no task")
    return lines


def statistic_lines(root: Path, info: Info) -> list[Line]:
    """Return statistics by episode as {"episode_index", "stats"}, as stored; [] for v2.0, which has none."""
    if info["codebase_version"] == layout.V30:
        return parquet_lists.read_statistics(root)
    path = root / layout.EPISODES_STATS
    lines = layout.read_lines(path)
    for line in lines:
        if not isinstance(line.get("episode_index"), int):
            raise RecordingError(f"{path}: a line says no episode_index: {_short(line)}")
    return [line if isinstance(line.get("stats"), dict) else line | {"stats": {}} for line in lines]


_OF_FORMAT = ("episode_index", "tasks", "length", "dataset_from_index", "dataset_to_index", "file_stem")


# Keys of v3.0: files of an episode, its statistics, and pandas' index.
_PLACES = re.compile(
    r"(?:data|meta/episodes)/(?:chunk|file)_index|videos/.+/(?:(?:chunk|file)_index|(?:from|to)_timestamp)"
    r"|stats/.+|__index_level_\d+__",
    re.DOTALL,
)


def own_keys(line: Line) -> Line:
    """Return the entries of an episode's line that the format does not define, whose meaning only their writer
    knows.
    """
    return {key: line[key] for key in line if key not in _OF_FORMAT and not _PLACES.fullmatch(key)}


def entry(root: Path, info: Info, line: Line) -> EpisodeEntry:
    """Return the entry of the episode of `line`. Raises: RecordingError if the line is incomplete."""
    v30 = info["codebase_version"] == layout.V30
    try:
        index = int(line["episode_index"])
        return EpisodeEntry(
            index=index,
            length=int(line["length"]),
            tasks=tuple(str(task) for task in line.get("tasks") or ()),
            data=_data_v30(root, info, line) if v30 else _file_v2(root, info, line, "data_path", ""),
            shared=v30,
            videos={
                key: _span_v30(root, info, line, key)
                if v30
                else Span(_file_v2(root, info, line, "video_path", key))
                for key in layout.video_keys(info["features"])
            },
        )
    except (KeyError, TypeError, ValueError) as error:
        where = root / (parquet_lists.EPISODES_FOLDER if v30 else layout.EPISODES)
        raise RecordingError(f"{where}: {_short(line)} is no episode: {error!r}") from error


def _short(line: Line) -> dict[str, Any]:
    return {key: line[key] for key in list(line)[:6]}


def _file_v2(root: Path, info: Info, line: Line, template: str, key: str) -> Path:
    index = int(line["episode_index"])
    default = layout.DATA_PATH if template == "data_path" else layout.VIDEO_PATH
    return layout.resolve(
        root,
        info.get(template) or default,
        episode_chunk=index // int(info.get("chunks_size") or layout.CHUNKS_SIZE),
        episode_index=index,
        episode_file=line.get("file_stem") or f"episode_{index:06d}",
        video_key=key,
    )


def _data_v30(root: Path, info: Info, line: Line) -> Path:
    return layout.resolve(
        root,
        info.get("data_path") or layout.DATA_PATH_V30,
        chunk_index=int(line["data/chunk_index"]),
        file_index=int(line["data/file_index"]),
    )


def _span_v30(root: Path, info: Info, line: Line, key: str) -> Span:
    path = layout.resolve(
        root,
        info.get("video_path") or layout.VIDEO_PATH_V30,
        video_key=key,
        chunk_index=int(line[f"videos/{key}/chunk_index"]),
        file_index=int(line[f"videos/{key}/file_index"]),
    )
    return Span(path, float(line[f"videos/{key}/from_timestamp"]))
