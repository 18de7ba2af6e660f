"""The metadata of a dataset as it is published: what is committed, and what one more episode makes of it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from runtime.datasets import layout
from runtime.datasets.features import Features, differences, plain_rate
from runtime.datasets.stats import Statistic, aggregate
from runtime.errors import RecordingError

Line = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Catalog:
    """info.json and the lines beside it, without anything that info.json does not yet count.

    info.json is written last, so `total_episodes` in it is what makes an episode part of the dataset.
    """

    root: Path
    info: Mapping[str, Any]  # {} in a folder that holds no dataset yet
    episodes: tuple[Line, ...]
    tasks: tuple[Line, ...]
    statistics: tuple[Line, ...]
    eva: tuple[Line, ...]

    @classmethod
    def read(cls, root: Path) -> Catalog:
        """What is committed in `root`; raises RecordingError where that is no v2.1 dataset or not whole."""
        if not (root / layout.INFO).exists():
            return cls(root, {}, (), (), (), ())
        info = layout.read_info(root)
        if info["codebase_version"] != layout.CODEBASE_VERSION:
            raise RecordingError(
                f"{root} is of version {info['codebase_version']}, published is {layout.CODEBASE_VERSION}"
            )
        total = int(info["total_episodes"])
        episodes = _committed(root / layout.EPISODES, total)
        catalog = cls(
            root,
            info,
            episodes,
            _committed_tasks(root, info, episodes),
            _committed(root / layout.EPISODES_STATS, total),
            _committed(root / layout.EVA_EPISODES, total),
        )
        catalog._require_whole()
        return catalog

    def _require_whole(self) -> None:
        expected = list(range(self.info["total_episodes"]))
        for name, lines in ((layout.EPISODES, self.episodes), (layout.EPISODES_STATS, self.statistics)):
            listed = [line["episode_index"] for line in lines]
            if listed != expected:
                raise RecordingError(
                    f"{self.root / name} lists {len(listed)} episodes that are not 0 to {len(expected) - 1}"
                )
        frames = sum(line["length"] for line in self.episodes)
        if frames != self.info["total_frames"]:
            raise RecordingError(
                f"{self.root / layout.INFO} counts {self.info['total_frames']} frames, "
                f"its episodes have {frames}"
            )

    @property
    def features(self) -> Mapping[str, Mapping[str, Any]]:
        """The declared features, {} where the dataset is yet to be created."""
        features: Mapping[str, Mapping[str, Any]] = self.info.get("features", {})
        return features

    def index_of(self, uuid: str) -> int | None:
        """Where the episode `uuid` is published; None where it is not."""
        return next((int(line["episode_index"]) for line in self.eva if line["uuid"] == uuid), None)

    def first_index(self, episode_index: int) -> int:
        """The global index of the first row of an episode."""
        return sum(line["length"] for line in self.episodes[:episode_index])

    def task_index(self, task: str) -> int:
        """The number of `task`, a new one where the dataset does not have it."""
        for line in self.tasks:
            if line["task"] == task:
                return int(line["task_index"])
        return max((int(line["task_index"]) for line in self.tasks), default=-1) + 1

    def require_same(self, robot: str, fps: float, features: Features) -> None:
        """Raise RecordingError with every difference where such an episode does not belong here."""
        if not self.info:
            return
        found = [
            f"{name} is {stated!r} in the dataset, {new!r} here"
            for name, stated, new in (
                ("robot_type", self.info.get("robot_type"), robot),
                ("fps", float(self.info["fps"]), fps),
            )
            if stated != new
        ]
        found += differences(self.features, features)
        if found:
            raise RecordingError(f"{self.root} holds other data: {'; '.join(found)}. Publish elsewhere")

    def created(self, robot: str, fps: float, features: Features) -> Catalog:
        """The catalog with an info.json, as it was or for the first time."""
        if self.info:
            return self
        info = {
            "codebase_version": layout.CODEBASE_VERSION,
            "robot_type": robot,
            "total_episodes": 0,
            "total_frames": 0,
            "total_tasks": 0,
            "total_videos": 0,
            "total_chunks": 0,
            "chunks_size": layout.CHUNKS_SIZE,
            "fps": plain_rate(fps),
            "splits": {},
            "data_path": layout.DATA_PATH,
            "video_path": layout.VIDEO_PATH if layout.video_keys(features) else None,
            "features": features,
        }
        return replace(self, info=info)

    def including(
        self, index: int, task: str, length: int, statistics: Mapping[str, Statistic], eva: Line
    ) -> Catalog:
        """The catalog with episode `index` added or replaced, and the totals that follow."""
        number = self.task_index(task)
        tasks = self.tasks
        if number not in {line["task_index"] for line in tasks}:
            tasks = (*tasks, {"task_index": number, "task": task})
        episodes = _with(self.episodes, {"episode_index": index, "tasks": [task], "length": length})
        totals = {
            "total_episodes": len(episodes),
            "total_frames": sum(line["length"] for line in episodes),
            "total_tasks": len(tasks),
            "total_videos": len(episodes) * len(layout.video_keys(self.features)),
            "total_chunks": -(-len(episodes) // int(self.info.get("chunks_size") or layout.CHUNKS_SIZE)),
            "splits": {"train": f"0:{len(episodes)}"},
        }
        return replace(
            self,
            info={**self.info, **totals},
            episodes=episodes,
            tasks=tasks,
            statistics=_with(self.statistics, {"episode_index": index, "stats": dict(statistics)}),
            eva=_with(self.eva, {"episode_index": index, **eva}),
        )

    def documents_before_data(self) -> dict[str, bytes]:
        """Files that may name more than there is; an existing modality.json stays, it may be edited."""
        documents = {layout.TASKS: _lines(self.tasks)}
        if not ((self.root / layout.INFO).exists() and (self.root / layout.MODALITY).exists()):
            documents[layout.MODALITY] = _object(modality(self.features))
        return documents

    def documents_after_data(self) -> dict[str, bytes]:
        """Files that say what there is, in the order in which they are written; info.json is the last."""
        return {
            layout.EPISODES_STATS: _lines(self.statistics),
            layout.STATS: _object(aggregate(line["stats"] for line in self.statistics)),
            layout.EVA_EPISODES: _lines(self.eva),
            layout.EPISODES: _lines(self.episodes),
            layout.INFO: _object(self.info),
        }


def modality(features: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """GR00T's meta/modality.json: the parts of state and action by actuator group, the cameras, the task."""
    prefix = "observation.images."
    return {
        "state": _groups(features["observation.state"]["names"]),
        "action": _groups(features["action"]["names"]),
        "video": {key.removeprefix(prefix): {"original_key": key} for key in layout.video_keys(features)},
        "annotation": {"human.task_description": {"original_key": "task_index"}},
    }


def _groups(names: list[str]) -> dict[str, dict[str, int]]:
    """Slices of a vector by the part of its entries' names before the last dot."""
    groups: dict[str, dict[str, int]] = {}
    for position, name in enumerate(names):
        group = groups.setdefault(name.rpartition(".")[0] or "robot", {"start": position, "end": position})
        group["end"] = position + 1
    return groups


def _committed(path: Path, total: int) -> tuple[Line, ...]:
    lines = [line for line in layout.read_lines(path) if line["episode_index"] < total]
    return tuple(sorted(lines, key=lambda line: int(line["episode_index"])))


def _committed_tasks(root: Path, info: Mapping[str, Any], episodes: tuple[Line, ...]) -> tuple[Line, ...]:
    used = {task for line in episodes for task in line["tasks"]}
    lines = layout.read_lines(root / layout.TASKS)
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
