"""Metadata of a dataset under publication: as committed, and as it will be with one more episode."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from runtime.core.errors import RecordingError
from runtime.datasets import layout, parquet_lists
from runtime.datasets.entries import (
    EpisodeEntry,
    entry,
    episode_lines,
    of_episodes,
    statistic_lines,
    task_lines,
)
from runtime.datasets.features import Features, feature_differences, figure_shapes, whole_rate
from runtime.datasets.layout import Line
from runtime.datasets.splits import with_more
from runtime.datasets.stats import Statistic, aggregate_statistics, fault


@dataclass(frozen=True, slots=True)
class Catalog:
    """Contents of info.json and of the metadata's lists, without entries that info.json does not count yet.

    info.json is written last, so its `total_episodes` decides which episodes belong to the dataset.
    """

    root: Path
    info: Mapping[str, Any]  # {} if the folder has no dataset yet
    episodes: tuple[Line, ...]
    tasks: tuple[Line, ...]
    statistics: tuple[Line, ...]
    eva: tuple[Line, ...]

    @classmethod
    def read(cls, root: Path) -> Catalog:
        """Read the catalog that is committed in `root`.

        Raises: RecordingError if it is incomplete or of a version that cannot be written.
        """
        if not (root / layout.INFO).exists():
            return cls(root, {}, (), (), (), ())
        info = layout.read_info(root)
        if info["codebase_version"] not in layout.WRITABLE_VERSIONS:
            raise RecordingError(
                f"{root} is of version {info['codebase_version']}, published are {layout.WRITABLE_VERSIONS}: "
                "convert it first"
            )
        episodes = tuple(episode_lines(root, info))
        try:
            eva = of_episodes(layout.read_lines(root / layout.EVA_EPISODES), episodes)
            statistics = of_episodes(statistic_lines(root, info), episodes)
        except (KeyError, TypeError, ValueError) as error:
            raise RecordingError(
                f"{root / layout.EVA_EPISODES}: a line says no episode_index: {error!r}"
            ) from error
        catalog = cls(
            root,
            info,
            episodes,
            _committed_tasks(root, info, episodes),
            tuple(statistics),
            tuple(eva),
        )
        catalog._require_whole()
        return catalog

    def _require_whole(self) -> None:
        expected = list(range(self.info["total_episodes"]))
        for name, lines in (("episodes", self.episodes), ("statistics", self.statistics)):
            listed = [line["episode_index"] for line in lines]
            if listed != expected:
                raise RecordingError(
                    f"{self.root / 'meta'} lists the {name} of {len(listed)} episodes that are not "
                    f"0 to {len(expected) - 1}"
                )
        frames = sum(line["length"] for line in self.episodes)
        if frames != self.info["total_frames"]:
            raise RecordingError(
                f"{self.root / layout.INFO} counts {self.info['total_frames']} frames, "
                f"its episodes have {frames}"
            )

    @property
    def features(self) -> Mapping[str, Mapping[str, Any]]:
        """Declared features, {} if the dataset does not exist yet."""
        features: Mapping[str, Mapping[str, Any]] = self.info.get("features", {})
        return features

    @property
    def version(self) -> str:
        """Version of the format, "" if the dataset does not exist yet."""
        return str(self.info.get("codebase_version", ""))

    def index_of(self, uuid: str) -> int | None:
        """Return the index of the published episode `uuid`; None if it is not published."""
        return next((int(line["episode_index"]) for line in self.eva if line["uuid"] == uuid), None)

    def first_index(self, episode_index: int) -> int:
        """Return the global index of the first row of an episode."""
        return sum(line["length"] for line in self.episodes[:episode_index])

    def task_index(self, task: str) -> int:
        """Return the index of `task`; if the dataset does not have the task, the next free index."""
        for line in self.tasks:
            if line["task"] == task:
                return int(line["task_index"])
        return max((int(line["task_index"]) for line in self.tasks), default=-1) + 1

    def require_same(self, robot: str, fps: float, features: Features) -> None:
        """Check that an episode with these properties fits the dataset.

        Raises: RecordingError, whose message names every difference.
        """
        if not self.info:
            return
        problems = [
            f"{name} is {stated!r} in the dataset, {new!r} here"
            for name, stated, new in (
                ("robot_type", self.info.get("robot_type"), robot),
                ("fps", float(self.info["fps"]), fps),
            )
            if stated != new
        ]
        problems += feature_differences(self.features, features)
        if problems:
            raise RecordingError(f"{self.root} holds other data: {'; '.join(problems)}. Publish elsewhere")

    def with_info(self, robot: str, fps: float, features: Features, version: str) -> Catalog:
        """Return the catalog with its info.json; if there is none yet, with a new one that has these properties."""
        if self.info:
            return self
        return replace(self, info=new_info({}, robot=robot, fps=fps, features=features, version=version))

    def line(self, index: int, tasks: Sequence[str], length: int) -> Line:
        """Return the line of episode `index` for the list of episodes: its tasks, its length, and its files in v3.0."""
        if index < len(self.episodes):
            return self.episodes[index] | {"tasks": list(tasks), "length": length}
        last = self.episodes[-1] if self.episodes else {}
        lists = {name: last.get(name, 0) for name in (parquet_lists.CHUNK, parquet_lists.FILE)}
        fields = single_file_line(self.info, self._next_file(), tasks, length, self.first_index(index))
        return fields | {"episode_index": index} | (lists if self.version == layout.V30 else {})

    def _next_file(self) -> int:
        """Return the number of the new episode's file: in v3.0 the next after all files, in v2.1 the episode's
        index.
        """
        size = int(self.info.get("chunks_size") or layout.CHUNKS_SIZE)
        numbers = [
            int(line[name]) * size + int(line[name.replace("chunk_index", "file_index")])
            for line in self.episodes
            for name in line
            if name.endswith("/chunk_index") and name != parquet_lists.CHUNK
        ]
        return max(numbers, default=len(self.episodes) - 1) + 1

    def entry(self, line: Line) -> EpisodeEntry:
        """Return the files of the episode of `line`.

        Raises: RecordingError if they also contain other episodes, because such files must not change.
        """
        result = entry(self.root, self.info, line)
        if not result.shared or result.index == len(self.episodes):
            return result
        files = {result.data, *(span.path for span in result.videos.values())}
        for other_line in self.episodes:
            other_entry = entry(self.root, self.info, other_line)
            if other_entry.index != result.index and files & {
                other_entry.data,
                *(span.path for span in other_entry.videos.values()),
            }:
                raise RecordingError(
                    f"{self.root}: episode {result.index} shares its files with episode {other_entry.index}: "
                    "it cannot be written anew in its place"
                )
        return result

    def with_episode(self, line: Line, statistics: Mapping[str, Statistic], eva: Line | None) -> Catalog:
        """Return the catalog with the episode of `line` added or replaced, and updated totals."""
        index = int(line["episode_index"])
        tasks = self.tasks
        for task in line["tasks"]:
            if task not in {row["task"] for row in tasks}:
                number = max((int(row["task_index"]) for row in tasks), default=-1) + 1
                tasks = (*tasks, {"task_index": number, "task": task})
        changed = replace(
            self,
            episodes=_with(self.episodes, line),
            tasks=tasks,
            statistics=_with(self.statistics, {"episode_index": index, "stats": dict(statistics)}),
            eva=self.eva if eva is None else _with(self.eva, {"episode_index": index, **eva}),
        )
        return replace(changed, info={**self.info, **changed.totals()})

    def totals(self) -> dict[str, Any]:
        """Return the counts of info.json."""
        count = len(self.episodes)
        totals = {
            "total_episodes": count,
            "total_frames": sum(line["length"] for line in self.episodes),
            "total_tasks": len(self.tasks),
            "splits": with_more(self.info.get("splits") or {}, int(self.info["total_episodes"]), count),
        }
        if self.version == layout.V30:
            return totals
        return totals | {
            "total_videos": count * len(layout.video_keys(self.features)),
            "total_chunks": -(-count // int(self.info.get("chunks_size") or layout.CHUNKS_SIZE)),
        }

    def documents_before_data(self) -> dict[str, bytes]:
        """Return the content by name of the files that are written before the data: tasks, and a missing modality.json.

        They may be written first because it does no harm if they list more than the data contain. An existing
        modality.json is left as it is, because users may edit it.
        """
        v30 = self.version == layout.V30
        documents = (
            {layout.TASKS_V30: parquet_lists.tasks_file(self.tasks)}
            if v30
            else {layout.TASKS: _lines(self.tasks)}
        )
        groups = modality(self.features)
        if groups and not ((self.root / layout.INFO).exists() and (self.root / layout.MODALITY).exists()):
            documents[layout.MODALITY] = _object(groups)
        return documents

    def documents_after_data(self) -> dict[str, bytes]:
        """Return the content by name of the files that declare the data, in the order of writing; info.json is the
        last.

        Raises:
            RecordingError: Statistics cannot be written or aggregated; names the episode and the feature.
        """
        try:
            return self._documents()
        except (KeyError, TypeError, ValueError) as error:
            for line in self.statistics:
                for key, statistic in line["stats"].items():
                    if key in self.features and (
                        reason := fault(statistic, figure_shapes(self.features[key]))
                    ):
                        raise RecordingError(
                            f"{self.root / 'meta'}: statistics of episode {line['episode_index']}, {key!r}: {reason}. "
                            "`convert` makes them anew in a copy"
                        ) from error
            raise

    def _documents(self) -> dict[str, bytes]:
        shared = {
            layout.STATS: _object(aggregate_statistics(line["stats"] for line in self.statistics)),
            layout.EVA_EPISODES: _lines(self.eva),
        }
        if self.version == layout.V30:
            lists = parquet_lists.episode_files(self.episodes, self.statistics)
            return {**shared, **lists, layout.INFO: _object(self.info)}
        return {
            layout.EPISODES_STATS: _lines(self.statistics),
            **shared,
            layout.EPISODES: _lines(self.episodes),
            layout.INFO: _object(self.info),
        }


def single_file_line(info: layout.Info, number: int, tasks: Sequence[str], length: int, first: int) -> Line:
    """Return the line of an episode that has its files to itself, i.e. they contain no other episode.

    Args:
        info: Content of info.json.
        number: Number of the files.
        tasks: Tasks of the episode.
        length: Number of the episode's rows.
        first: Index of the episode's first row in the dataset.
    """
    line: Line = {"episode_index": number, "tasks": list(tasks), "length": length}
    if info["codebase_version"] != layout.V30:
        return line
    chunk, file = divmod(number, int(info.get("chunks_size") or layout.CHUNKS_SIZE))
    line |= {
        "data/chunk_index": chunk,
        "data/file_index": file,
        "dataset_from_index": first,
        "dataset_to_index": first + length,
    }
    for key in layout.video_keys(info["features"]):
        line |= {
            f"videos/{key}/chunk_index": chunk,
            f"videos/{key}/file_index": file,
            f"videos/{key}/from_timestamp": 0.0,
            f"videos/{key}/to_timestamp": length / float(info["fps"]),
        }
    return line | {parquet_lists.CHUNK: 0, parquet_lists.FILE: 0}


def new_info(
    given: Mapping[str, Any],
    *,
    robot: str | None,
    fps: float,
    features: Mapping[str, Mapping[str, Any]],
    version: str,
) -> dict[str, Any]:
    """Return info.json of a dataset without episodes; keys of `given` that the format does not define are added."""
    v30 = version == layout.V30
    info: dict[str, Any] = {
        "codebase_version": version,
        "robot_type": robot,
        "total_episodes": 0,
        "total_frames": 0,
        "total_tasks": 0,
    }
    if v30:
        info |= {"data_files_size_in_mb": 100, "video_files_size_in_mb": 200}
    else:
        info |= {"total_videos": 0, "total_chunks": 0}
    video_path = layout.VIDEO_PATH_V30 if v30 else layout.VIDEO_PATH
    info |= {
        "chunks_size": layout.CHUNKS_SIZE,
        "fps": whole_rate(fps),
        "splits": {},
        "data_path": layout.DATA_PATH_V30 if v30 else layout.DATA_PATH,
        "video_path": video_path if layout.video_keys(features) else None,
        "features": dict(features),
    }
    return info | {key: value for key, value in given.items() if key not in layout.INFO_KEYS}


def modality(features: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return GR00T's meta/modality.json: the parts of state and action by actuator group, the cameras and the task.

    {} if the dataset has no state or action under the usual names, or their dimensions have no names.
    """
    names = {key: features.get(key, {}).get("names") for key in ("observation.state", "action")}
    if not all(isinstance(entries, list) for entries in names.values()):
        return {}
    prefix = "observation.images."
    return {
        "state": _groups(names["observation.state"] or []),
        "action": _groups(names["action"] or []),
        "video": {key.removeprefix(prefix): {"original_key": key} for key in layout.video_keys(features)},
        "annotation": {"human.task_description": {"original_key": "task_index"}},
    }


def _groups(names: list[str]) -> dict[str, dict[str, int]]:
    """Return start and end of each group of dimensions; a group is the part of a dimension's name before the
    last dot.
    """
    groups: dict[str, dict[str, int]] = {}
    for position, name in enumerate(names):
        group = groups.setdefault(name.rpartition(".")[0] or "robot", {"start": position, "end": position})
        group["end"] = position + 1
    return groups


def _committed_tasks(root: Path, info: Mapping[str, Any], episodes: tuple[Line, ...]) -> tuple[Line, ...]:
    used = {task for line in episodes for task in line["tasks"]}
    lines = task_lines(root, info)
    total = int(info.get("total_tasks", len(lines)))
    return tuple(line for line in lines if line["task_index"] < total or line["task"] in used)


def _with(lines: tuple[Line, ...], new: Line) -> tuple[Line, ...]:
    by_index = {int(line["episode_index"]): line for line in lines} | {int(new["episode_index"]): new}
    return tuple(by_index[index] for index in sorted(by_index))


def _lines(lines: tuple[Line, ...]) -> bytes:
    return b"".join(_json(line) + b"\n" for line in lines)


def _object(content: Mapping[str, Any]) -> bytes:
    return _json(content, indent=4) + b"\n"


def _json(content: Mapping[str, Any], indent: int | None = None) -> bytes:
    return json.dumps(content, indent=indent, ensure_ascii=False, allow_nan=False).encode()
