"""Import of a dataset's episode into a lab: its numbers and images in a folder like those of the lab's own episodes.

The dataset remains the original: its images are encoded anew for the folder, its numbers are copied.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import robots
from runtime.core.durable_files import sync_folder
from runtime.core.errors import RecordingError
from runtime.core.types import Float32
from runtime.datasets import layout
from runtime.datasets.episode_uuids import uuids_of
from runtime.datasets.extra_streams import ExtraStreams, dimension_names, read_extra_streams
from runtime.datasets.mapping import ColumnMapping, video_key
from runtime.datasets.reader import Dataset, RecordedEpisode
from runtime.datasets.video_frames import ImageSequence
from runtime.ipc.messages import ExecutedTick
from runtime.recording.base import IMPORTED, Outcome, Row
from runtime.recording.episode import EpisodeJournal
from runtime.recording.files import disk_error
from runtime.recording.scrub import require_intact
from runtime.recording.settings import RecordingSettings

STATES = ("observation.state", "observation.qpos")  # columns of measured joints, by preference
ACTION = "action"


@dataclass(frozen=True, slots=True)
class SourceRobot:
    """Facts for an import that a dataset does not state.

    `state` names the column of measured joints; `robot` is the described robot that has these joints, "" if there is
    none.
    """

    state: str = ""
    robot: str = ""

    def names(self, dataset: Dataset) -> list[str]:
        """Return the names of the state's dimensions. Raises: RecordingError if `robot` has another number of
        joints.
        """
        feature = dataset.features[self.state]
        width = int(feature["shape"][0])
        if self.robot:
            joints = list(robots.load_robot(self.robot).joint_names)
            if len(joints) != width:
                raise RecordingError(
                    f"{dataset.root}: {self.state} has {width} numbers, {self.robot} has {len(joints)} joints"
                )
            return joints
        stated = dimension_names(feature)
        return stated if len(stated) == width else [f"{self.state}[{k}]" for k in range(width)]


def resolve_source_robot(dataset: Dataset, state: str = "", robot: str = "") -> SourceRobot:
    """Return column and robot after a check; without `state`, the first column with a usual name is chosen.

    Raises: RecordingError, whose message names the valid choices.
    """
    vectors = [name for name, feature in dataset.features.items() if _is_vector(feature)]
    column = state or next((name for name in STATES if name in vectors), "")
    if column not in vectors:
        raise RecordingError(
            f"{dataset.root} has no column {column or ' or '.join(STATES)} of measured joints: name one of "
            f"{', '.join(vectors) or 'none, it has no vectors'}"
        )
    if robot and not robots.is_described(robot):
        raise RecordingError(f"robot {robot!r} does not exist; there are: {', '.join(robots.robot_names())}")
    return SourceRobot(column, robot)


def import_episode(dataset: Dataset, index: int, episodes: Path, told: SourceRobot) -> tuple[str, bool]:
    """Create the folder of episode `index` in `episodes`; it appears complete or not at all.

    Args:
        dataset: Dataset, in the data folder that contains `episodes`.
        index: Index of the episode in the dataset.
        episodes: Folder of the lab's episodes.
        told: Column of measured joints, and robot.

    Returns:
        Uuid of the episode, and whether its folder is new.

    Raises:
        RecordingError: The episode cannot be read or written.
        DamagedError: The folder exists and differs from the imported data.
    """
    uuid = uuids_of(dataset.root)[index]
    folder, drafts = episodes / uuid, episodes.parent / f".{IMPORTED}"
    if folder.exists():
        require_intact(folder)
        return uuid, False
    try:
        shutil.rmtree(drafts / uuid, ignore_errors=True)  # left by a crash
        draft = _recorded(dataset, index, uuid, drafts, told, os.path.relpath(dataset.root, episodes.parent))
        episodes.mkdir(parents=True, exist_ok=True)
        os.rename(draft, folder)
        sync_folder(episodes)
    except OSError as error:
        raise disk_error("importing into", folder, error) from error
    finally:
        shutil.rmtree(drafts / uuid, ignore_errors=True)
    return uuid, True


def _recorded(dataset: Dataset, index: int, uuid: str, root: Path, source: SourceRobot, name: str) -> Path:
    keys = [*layout.video_keys(dataset.features), *layout.image_keys(dataset.features)]
    cameras = {key.removeprefix(video_key("")).replace("/", "."): key for key in keys}
    action = ACTION if _is_vector(dataset.features.get(ACTION, {})) else None
    episode = dataset.episode(index, ColumnMapping(state=source.state, action=action, videos=cameras))
    extra = read_extra_streams(dataset, index, source.state)
    settings = RecordingSettings(min_free_bytes=0)
    with ExitStack() as stack:
        pictures = {camera: stack.enter_context(episode.pictures(camera)) for camera in cameras}
        manifest = _manifest(dataset, episode, uuid, source, name, _sizes(pictures, settings), extra)
        journal = EpisodeJournal(root, settings, patient=True)
        journal.begin(manifest)
        try:
            for row in range(episode.length):
                images = {camera: frames[row] for camera, frames in pictures.items()}
                journal.append(_row(episode, row, images, extra))
                journal.append(_tick(episode, row))
        except BaseException as error:
            journal.end(Outcome("failed", f"the import of row {row} failed: {error}", time.time()))
            raise
        reason = "; ".join([f"imported: episode {index} of {name}", *extra.left_out])
        journal.end(Outcome("finished", reason, time.time()))
    if losses := journal.pop_lost_cameras():
        raise RecordingError(f"{dataset.root}, episode {index}: {'; '.join(loss.text for loss in losses)}")
    return root / uuid


def _manifest(
    dataset: Dataset,
    episode: RecordedEpisode,
    uuid: str,
    source: SourceRobot,
    name: str,
    sizes: Mapping[str, Any],
    extra: ExtraStreams,
) -> dict[str, Any]:
    joints = source.names(dataset)
    own = str(dataset.info.get("robot_type") or "")
    return {
        "format": 1,
        "uuid": uuid,
        "station": IMPORTED,  # no real station
        "kind": IMPORTED,
        "mode": "observe",
        "task": episode.task,
        "robot": {
            "name": source.robot or own,
            "joint_names": joints,
            "eef_names": list(extra.eef_names),
            "dim": len(joints),
            "eef_dim": len(extra.eef_names),
        },
        "fps": dataset.fps,
        "control_rate": dataset.fps,
        "cameras": sizes,
        "streams": dict.fromkeys(extra.vectors, True),
        "capture_streams": [],
        "started_wall": time.time(),
        "started_monotonic": 0.0,
        "configuration": {},
        "imported": {
            "dataset": name,
            "index": episode.index,
            "state": source.state,
            "robot": source.robot,
            "columns": dict(extra.columns),
        },
    }


def _sizes(pictures: Mapping[str, ImageSequence], settings: RecordingSettings) -> dict[str, Any]:
    captured = {camera: (frames[0].shape[0], frames[0].shape[1]) for camera, frames in pictures.items()}
    sizes = settings.sizes(captured)
    return {camera: {"width": width, "height": height} for camera, (height, width) in sizes.items()}


def _row(episode: RecordedEpisode, row: int, pictures: Mapping[str, Any], extra: ExtraStreams) -> Row:
    return Row(
        index=row,
        step=row,
        tick_time=row / episode.fps,
        sequence=row + 1,
        qpos=episode.qpos[row],
        action=_action(episode, row),
        captured={},
        pictures=pictures,
        control_source="unknown",
        **extra.row(row),
    )


def _tick(episode: RecordedEpisode, row: int) -> ExecutedTick:
    at = row / episode.fps
    return ExecutedTick(row, 0, at, at, row + 1, "unknown", episode.qpos[row], None, _action(episode, row))


def _action(episode: RecordedEpisode, row: int) -> Float32:
    """Return the action of a row; NaN if the dataset has no action, or its width differs from that of the joints."""
    if episode.action is None or episode.action.shape != episode.qpos.shape:
        return np.full_like(episode.qpos[row], np.nan)
    return np.asarray(episode.action[row], np.float32)


def _is_vector(feature: Mapping[str, Any]) -> bool:
    shape = list(feature.get("shape") or ())
    return str(feature.get("dtype")).startswith("float") and len(shape) == 1 and int(shape[0]) > 1
