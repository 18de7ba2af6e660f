"""Episodes of datasets in the form of recordings, so that the same modules play both."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, UUID, uuid5

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

import robots
from evaweb.core.errors import NotFound
from evaweb.datasets.episode_list import recorded_lines, result_of
from evaweb.datasets.overview import camera_keys, open_cached
from evaweb.stations.robot_geometry import drawn_robot
from runtime.core.sentences import Pattern
from runtime.datasets import layout
from runtime.datasets.entries import EpisodeEntry, Span
from runtime.datasets.reader import Dataset
from runtime.datasets.sidecars import sidecar_paths
from runtime.recording.files import RecordingError
from runtime.recording.layout import Layout
from runtime.recording.reader import Episode
from runtime.recording.tables import SCHEMAS

_HAS_NO_CAMERA_HAS = Pattern(
    "datasets.playing.has_no_camera_has",
    "{name} has no camera {camera!r:.80}; it has {cameras}",
)
_HAS_NO_EPISODE_THERE = Pattern(
    "datasets.playing.has_no_episode_there",
    "{name} has no episode {index}, there are {count}",
)
_ROBOT_DOES_NOT_EXIST_THERE = Pattern(
    "datasets.playing.robot_does_not_exist_there",
    "robot {robot!r:.80} does not exist; there are: {names}",
)
_EPISODE_HAS_JOINTS_HAS_CHOOSE = Pattern(
    "datasets.playing.episode_has_joints_has_choose",
    "the episode has {count} joints, {robot} has {count_2}: choose another robot",
)

STATES = ("observation.state", "observation.qpos")  # columns of measured joints, in order of preference
_SOURCE = "control_source"
Array = NDArray[Any]


@dataclass(frozen=True, slots=True, eq=False)
class PlayedEpisode:
    """Episode of a dataset; `robot` is the robot to which its values belong, "" if unknown.

    `robot_is_assumed` is True if the user has chosen the robot, whatever the dataset declares; the values are then
    taken in the order of that robot's joints.
    """

    name: str  # name of the dataset
    index: int
    dataset: Dataset
    entry: EpisodeEntry
    told: Mapping[str, Any]  # this program's own line about it; {} for a foreign episode
    robot: str
    robot_is_assumed: bool

    @property
    def result(self) -> str:
        """Label that its operator gave the episode, "" if there is none."""
        return result_of(self.told)

    @property
    def uuid(self) -> str:
        """UUID of the recording, "" for a foreign episode."""
        try:
            return str(UUID(str(self.told["uuid"])))
        except (KeyError, ValueError):
            return ""

    @property
    def fps(self) -> float:
        return self.dataset.fps

    @property
    def frames(self) -> int:
        return self.entry.length

    @property
    def task(self) -> str:
        return ", ".join(self.entry.tasks)

    @property
    def cameras(self) -> dict[str, str]:
        """Dict from each camera's short name to the feature of its images."""
        return camera_keys(dict(self.dataset.features))

    def video(self, camera: str) -> Span | None:
        """Return the span of a camera's video; None if its images are in a column. Raises: NotFound."""
        key = self.cameras.get(camera)
        if key is None:
            raise NotFound(
                _HAS_NO_CAMERA_HAS(name=self.name, camera=camera, cameras=", ".join(self.cameras) or "none")
            )
        return self.entry.videos.get(key)

    @property
    def state(self) -> str:
        """Column of measured joints, "" if there is none."""
        vectors = _vectors(self.dataset)
        usual = [name for name in STATES if name in vectors]
        return next(iter([*usual, *(name for name in vectors if name.startswith("observation"))]), "")

    @property
    def action(self) -> str:
        """Column of commanded joints, "" if there is none."""
        vectors = _vectors(self.dataset)
        return (
            "action"
            if "action" in vectors
            else next((name for name in vectors if name.startswith("action")), "")
        )

    def names(self, column: str) -> list[str]:
        """Return the names of a column's values."""
        feature = self.dataset.features.get(column, {})
        width, names = int((feature.get("shape") or [0])[0]), feature.get("names")
        if isinstance(names, Mapping) and len(names) == 1:  # some datasets use {"motors": [...]}
            names = next(iter(names.values()))
        labels = [str(name) for name in names] if isinstance(names, list) else []
        return labels if len(labels) == width else [f"{column}[{k}]" for k in range(width)]

    def sidecars(self) -> dict[str, Path]:
        """Return the sidecar files of the episode by kind."""
        return sidecar_paths(self.dataset.root, self.uuid) if self.uuid else {}


def load_played_episode(name: str, index: int, robot: str = "") -> PlayedEpisode:
    """Return episode `index` of a dataset, interpreted for `robot` if given. Raises: NotFound, RecordingError."""
    dataset = open_cached(name)
    listed = next((entry for entry in dataset.episodes if entry.index == index), None)
    if listed is None:
        raise NotFound(_HAS_NO_EPISODE_THERE(name=name, index=index, count=len(dataset.episodes)))
    if robot and not robots.is_described(robot):
        raise NotFound(_ROBOT_DOES_NOT_EXIST_THERE(robot=robot, names=", ".join(robots.robot_names())))
    own = str(dataset.info.get("robot_type") or "")
    return PlayedEpisode(
        name, index, dataset, listed, recorded_lines(dataset).get(index, {}), robot or own, bool(robot)
    )


def _vectors(dataset: Dataset) -> list[str]:
    return [
        key
        for key, feature in dataset.features.items()
        if str(feature.get("dtype", "")).startswith("float")
        and len(feature.get("shape") or ()) == 1
        and int(feature["shape"][0]) > 1
    ]


def as_recording(shown: PlayedEpisode) -> Episode:
    """Return the episode with the tables of a recording, so that it can be played like one.

    If a sidecar has the raw, smoothed and executed action streams, they are included. If state and action have
    different dimensions, the joints of the result are first the dimensions of the state, then those of the action: the
    dimensions of the state have no commanded values (NaN), those of the action no measured values (NaN).
    Raises: RecordingError.
    """
    table = shown.dataset.table(shown.index)
    joints, measured, commanded = _numbers(shown, table)
    manifest = _manifest(shown, joints)
    form = Layout.from_manifest(manifest)
    rows = pa.table(
        {
            "tick_time": np.arange(shown.frames) / shown.fps,
            _SOURCE: table[_SOURCE] if _SOURCE in table.column_names else pa.nulls(shown.frames, pa.string()),
            "qpos": _lists(measured),
        }
    )
    streams = shown.sidecars().get("streams")
    if streams is not None and len(joints) == measured.shape[1]:
        return _with_streams(shown, streams, rows)
    ticks = pa.table(
        {
            "step": np.arange(shown.frames),
            "planned": np.arange(shown.frames) / shown.fps,
            "qpos": _lists(measured),
            "executed": _lists(commanded),
            "changes": pa.array([[]] * shown.frames, pa.list_(pa.string())),
            "refused": np.zeros(shown.frames, bool),
            "chunk_id": np.full(shown.frames, -1),
        }
    )
    return _episode(
        shown,
        form,
        manifest,
        rows,
        ticks,
        *(SCHEMAS[name](form).empty_table() for name in ("smoothed", "raw")),
    )


def _numbers(episode: PlayedEpisode, table: Any) -> tuple[list[str], Array, Array]:
    """Return joint names, and measured and commanded joints [N, D]; NaN for joints that a column lacks."""
    state, action = episode.state, episode.action
    if not state and not action:
        raise RecordingError(f"{episode.name} has no column of joints, neither measured nor commanded")
    names = [episode.names(column) if column else [] for column in (state, action)]
    values = [
        _values(table, column, len(labels)) for column, labels in zip((state, action), names, strict=True)
    ]
    if len(names[0]) == len(names[1]):
        return names[0], values[0], values[1]
    nothing = [np.full_like(columns, np.nan) for columns in values]
    joints = [*names[0], *(f"action {name}" for name in names[1])] if state else names[1]
    return joints, np.hstack([values[0], nothing[1]]), np.hstack([nothing[0], values[1]])


def _values(table: Any, column: str, width: int) -> Array:
    if not column:
        return np.zeros((table.num_rows, 0), np.float32)
    if column not in table.column_names:
        raise RecordingError(f"a column {column!r} is declared, but the rows have {table.column_names}")
    stored = table[column].combine_chunks()
    flat = np.asarray(stored.flatten().to_numpy(zero_copy_only=False), np.float32)
    if stored.null_count or flat.size != table.num_rows * width:
        raise RecordingError(f"rows of column {column!r} have not {width} numbers each, as is declared")
    return flat.reshape(table.num_rows, width)


def _lists(values: Array) -> Any:
    flat = pa.array(np.ascontiguousarray(values, np.float32).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _manifest(episode: PlayedEpisode, joints: list[str]) -> dict[str, Any]:
    return {
        "uuid": episode.uuid or str(uuid5(NAMESPACE_URL, f"{episode.name}#{episode.index}")),
        "fps": episode.fps,
        "control_rate": episode.fps,
        "started_monotonic": 0.0,
        "task": episode.task,
        "robot": {"name": episode.robot, "dim": len(joints), "joint_names": _renamed_joints(episode, joints)},
        "streams": {},
        "cameras": {},
        "capture_streams": [],
    }


def _renamed_joints(episode: PlayedEpisode, joints: list[str]) -> list[str]:
    """Return the joint names, those of the robot if the user has chosen one. Raises: NotFound if counts differ."""
    if not episode.robot_is_assumed:
        return joints
    robot_joints = list(drawn_robot(episode.robot).robot.joint_names)
    if len(robot_joints) != len(joints):
        raise NotFound(
            _EPISODE_HAS_JOINTS_HAS_CHOOSE(count=len(joints), robot=episode.robot, count_2=len(robot_joints))
        )
    return robot_joints


def _episode(
    played: PlayedEpisode,
    form: Layout,
    manifest: Mapping[str, Any],
    rows: Any,
    ticks: Any,
    smoothed: Any,
    raw: Any,
) -> Episode:
    return Episode(
        path=played.dataset.root,
        layout=form,
        manifest=manifest,
        outcome=None,
        frames=played.frames,
        rows=rows,
        ticks=ticks,
        smoothed=smoothed,
        raw=raw,
        events=(),
        videos={},
    )


# --- the three action streams --------------------------------------------------------------------------------


def _with_streams(episode: PlayedEpisode, path: Path, rows: Any) -> Episode:
    """Return the episode with the raw, smoothed and executed streams of the sidecar file."""
    try:
        table = pq.read_table(path)
        manifest = json.loads((table.schema.metadata or {})[b"eva.manifest"])
        form = Layout.from_manifest(manifest)
        by = {
            name: table.filter(pa.compute.equal(table["stream"], name))
            for name in ("raw", "smoothed", "executed")
        }
        executed, smoothed, raw = by["executed"], by["smoothed"], by["raw"]
        ticks = _renamed(
            executed,
            {"step": "step", "planned": "time", "qpos": "measured", "executed": "action"},
            ("changes", "refused"),
            ("chunk_id",),
        )
        planned = _renamed(smoothed, {"smoothed": "action"}, ("step", "chunk_ids", "weights"), ())
        intended = _renamed(
            raw,
            {},
            (
                "chunk_id",
                "observation_step",
                "index",
                "action",
                "space",
                "mistimed",
                "inference_ms",
                "strategy",
                "overlap",
            ),
            ("arrival_step", "target_step", "delay"),
        )
    except (OSError, pa.ArrowException, KeyError, ValueError) as error:
        raise RecordingError(f"{path} is no table of action streams: {error}") from error
    return _episode(episode, form, manifest, rows, ticks, planned, intended)


def _renamed(table: Any, new: Mapping[str, str], same: tuple[str, ...], numbers: tuple[str, ...]) -> Any:
    """Return a table of selected columns, some of them with new names.

    `new` maps the new name of a column to its present name. The columns in `same` and `numbers` keep their names. In
    the columns of `numbers`, null becomes -1. All other columns are left out.
    """
    columns = {name: table[old] for name, old in new.items()} | {name: table[name] for name in same}
    return pa.table(columns | {name: table[name].fill_null(-1) for name in numbers})


def annotations(shown: PlayedEpisode) -> list[dict[str, Any]]:
    """Return the segments in the dataset's sidecar. Raises: RecordingError if the file is damaged."""
    path = shown.sidecars().get("annotations")
    return [] if path is None else layout.read_lines(path)


def reviews(shown: PlayedEpisode) -> list[dict[str, Any]]:
    """Return the reviews in the dataset's sidecar, oldest first. Raises: RecordingError if the file is damaged."""
    path = shown.sidecars().get("reviews")
    return [] if path is None else layout.read_lines(path)
