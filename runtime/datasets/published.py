"""Publishes a finished episode of the journal into a LeRobot v2.1 dataset; re-runnable at any time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from runtime.datasets import features as declared
from runtime.datasets import layout
from runtime.datasets.catalog import Catalog
from runtime.datasets.columns import (
    Columns,
    column_features,
    column_statistics,
    placed_columns,
    recorded_columns,
    table,
)
from runtime.datasets.journal import RecordedJournal, read_journal
from runtime.datasets.mapping import video_key
from runtime.datasets.remux import VideoFacts, remux
from runtime.datasets.staging import Staging, locked, recover, require_empty
from runtime.datasets.stats import Statistic, video_statistic
from runtime.errors import RecordingError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

SUCCESS = "next.success"
SIMULATED = "sim"  # the mode, and the control source of its rows
CODEC, PIXELS = "h264", "yuv420p"  # what our recorder writes


@dataclass(frozen=True, slots=True)
class Published:
    """Where an episode went."""

    dataset: Path
    episode_index: int
    frames: int
    created: bool  # False: it was there already and has been written anew at the same index


def publish(
    episode: Path, dataset: Path, *, success: bool | None = None, include_interrupted: bool = False
) -> Published:
    """Publish the episode folder `episode` into the dataset folder `dataset`, created where it is absent.

    `success` None takes the outcome's own word, if it has one. An episode that is there already (by its uuid)
    is written anew at its index. Raises RecordingError where the episode is not finished, incomplete, or of
    other features than the dataset.
    """
    journal = read_journal(Path(episode))
    _require_publishable(journal, include_interrupted)
    if success is None and isinstance(journal.outcome.get("success"), bool):
        success = journal.outcome["success"]
    root = Path(dataset)
    with locked(root):
        recover(root)
        catalog = Catalog.read(root)
        if not catalog.info:
            require_empty(root)
        return _publish(journal, catalog, success)


def never_published(manifest: Mapping[str, object]) -> str:
    """Why no dataset may ever hold the run of that manifest, to follow its name; "" where one may."""
    if manifest.get("mode") != SIMULATED:
        return ""
    return (
        "is a run of mode sim: its actions went to a simulated robot alone, so that its pictures do not show "
        "what they did; it is no rollout and no demonstration"
    )


def _require_publishable(journal: RecordedJournal, include_interrupted: bool) -> None:
    why = never_published(journal.manifest)
    if why:
        raise RecordingError(f"{journal.folder} {why}")
    invented = int((journal.scalars("control_source") == SIMULATED).sum()) if journal.frames else 0
    if invented:
        raise RecordingError(f"{journal.folder}: {invented} of its rows are actions of a simulated robot")
    status = journal.outcome.get("status")
    if status != "finished" and not include_interrupted:
        raise RecordingError(
            f"{journal.folder} is {status}: {journal.outcome.get('reason')}. "
            "Publish it all the same with --include-interrupted"
        )
    if not journal.frames:
        raise RecordingError(f"{journal.folder} has no rows")


def _publish(journal: RecordedJournal, catalog: Catalog, success: bool | None) -> Published:
    root = catalog.root
    features = _features(journal, _with_success(journal, catalog, success))
    catalog.require_same(journal.robot, journal.fps, features)
    catalog = catalog.created(journal.robot, journal.fps, features)
    index, created = _place(journal, catalog)
    parquet = layout.data_file(root, catalog.info, index)
    videos = {
        camera: layout.video_file(root, catalog.info, video_key(camera), index) for camera in journal.cameras
    }
    with Staging(root, index, [*videos.values(), parquet]) as staging:
        statistics = {}
        for camera, final in videos.items():
            statistics[video_key(camera)] = _stage_video(journal, camera, staging.path(final))
        columns = placed_columns(
            recorded_columns(journal, features),
            episode_index=index,
            first_index=catalog.first_index(index),
            task_index=catalog.task_index(journal.task),
            success=bool(success) if SUCCESS in features else None,
        )
        _write_table(columns, features, staging.path(parquet))
        statistics |= column_statistics(columns, features)
        catalog = catalog.including(
            index, journal.task, journal.frames, statistics, _eva(journal, columns, success)
        )
        staging.place(catalog.documents_before_data(), catalog.documents_after_data())
    return Published(root, index, journal.frames, created)


def _with_success(journal: RecordedJournal, catalog: Catalog, success: bool | None) -> bool:
    """Whether the episode gets a success column: as the dataset has it, or, in a new one, if it is known."""
    if not catalog.info:
        return success is not None
    wanted = SUCCESS in catalog.features
    if wanted and success is None:
        raise RecordingError(
            f"{catalog.root} says of every episode whether it succeeded ({SUCCESS}), of {journal.folder} "
            "that is not known: give --success or --failure"
        )
    return wanted


def _features(journal: RecordedJournal, with_success: bool) -> declared.Features:
    columns = column_features(journal, with_success)
    leading = {key: columns.pop(key) for key in ("observation.state", "action")}
    videos = {
        video_key(camera): declared.video(height, width, journal.fps, CODEC, PIXELS)
        for camera, (height, width) in journal.cameras.items()
    }
    return leading | videos | columns


def _place(journal: RecordedJournal, catalog: Catalog) -> tuple[int, bool]:
    """The index of the episode, and whether it is new; refuses a change of length: it would shift others."""
    index = catalog.index_of(journal.uuid)
    if index is None:
        return len(catalog.episodes), True
    length = catalog.episodes[index]["length"]
    if length != journal.frames:
        raise RecordingError(
            f"{journal.folder} has {journal.frames} rows, published in {catalog.root} as episode {index} it "
            f"has {length}: the global index of later episodes would shift. Publish to a new dataset"
        )
    return index, False


def _stage_video(journal: RecordedJournal, camera: str, staged: Path) -> Statistic:
    source = journal.episode.videos[camera]
    facts = remux(source, staged, journal.frames, journal.fps)
    expected = VideoFacts(*journal.cameras[camera], CODEC, PIXELS)
    if facts != expected:
        raise RecordingError(f"{source} is {facts}, the manifest promises {expected}")
    return video_statistic(staged, journal.frames)


def _write_table(columns: Columns, features: declared.Features, path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        pq.write_table(table(columns, features), path)
    except (OSError, pa.ArrowException) as error:
        raise RecordingError(f"{path} cannot be written: {error}") from error


def _eva(journal: RecordedJournal, columns: Columns, success: bool | None) -> dict[str, Any]:
    """Our own line about the episode: what LeRobot's files have no place for."""
    manifest = journal.manifest
    told = ("station", "kind", "mode", "strategy", "started_wall", "configuration_hash", "versions")
    return {
        "uuid": journal.uuid,
        "frames": journal.frames,
        "task": journal.task,
        **{key: manifest[key] for key in told if key in manifest},
        "outcome": dict(journal.outcome),
        "success": success,
        "eef_state": _provenance(columns, "eef_measured", "measured", "forward kinematics"),
        "eef_action": _provenance(columns, "eef_action_reported", "reported", "forward kinematics"),
    }


def _provenance(columns: Mapping[str, NDArray[np.generic]], flag: str, true: str, false: str) -> str | None:
    """Where a pose column comes from, in all rows, or "mixed": then the flag column says it row by row."""
    if flag not in columns:
        return None
    flags = columns[flag]
    return true if flags.all() else "mixed" if flags.any() else false
