"""Publication of a finished episode of the journal into a LeRobot dataset; it may be repeated at any time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from runtime.core.errors import RecordingError
from runtime.core.types import Result
from runtime.datasets import features as declared
from runtime.datasets import layout
from runtime.datasets.catalog import Catalog
from runtime.datasets.columns import (
    Columns,
    column_features,
    column_statistics,
    position_columns,
    recorded_columns,
    table,
    without_later,
)
from runtime.datasets.finished_episode import FinishedEpisode, read_finished_episode
from runtime.datasets.mapping import video_key
from runtime.datasets.remux import VideoFacts, codec_of, remux
from runtime.datasets.rows import write_table
from runtime.datasets.sidecars import STREAMS, read_sidecars, sidecar_path
from runtime.datasets.staging import Staging, lock_dataset, recover, require_empty
from runtime.datasets.stats import Statistic, video_statistic
from runtime.recording.base import IMPORTED
from runtime.recording.export import export_table
from runtime.recording.labels import latest_label
from runtime.recording.layout import simulated_bench
from runtime.recording.scrub import require_intact

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

SUCCESS = "next.success"
SIMULATED = "sim"  # name of the mode and of the control source of its rows
PIXELS = "yuv420p"  # pixel format of our recorder


@dataclass(frozen=True, slots=True)
class Published:
    """Location of a published episode, and whether it is new in the dataset."""

    dataset: Path
    episode_index: int
    frames: int
    created: bool  # False: it existed and was written again at the same index
    remark: str = ""  # facts that could not be verified


def publish(
    episode: Path,
    dataset: Path,
    *,
    success: bool | None = None,
    include_interrupted: bool = False,
    version: str | None = None,
    sides: Mapping[str, Path] | None = None,
) -> Published:
    """Publish the episode folder `episode` into the dataset folder `dataset`, which is created if it does not exist.

    An episode that the dataset already has (by its uuid) is written again at its index. The three action streams are
    published as a sidecar.

    Args:
        episode: Folder of the recorded episode.
        dataset: Folder of the dataset.
        success: Whether the episode succeeded; None: from its outcome, else from its newest label.
        include_interrupted: Also publish an episode that did not finish.
        version: Version of a new dataset, None for v2.1; an existing dataset keeps its own.
        sides: Further sidecars by kind ("annotations", "reviews": JSON Lines).

    Raises:
        RecordingError: The episode is unfinished, discarded or incomplete, or has other features than the dataset.
        DamagedError: A file of the episode differs from what was recorded.
    """
    if version not in (None, *layout.WRITABLE_VERSIONS):
        raise RecordingError(f"version is {version!r}, published are {layout.WRITABLE_VERSIONS}")
    contents = read_sidecars(sides or {})
    verdict = require_intact(Path(episode))
    journal = read_finished_episode(Path(episode))
    _require_publishable(journal, include_interrupted)
    if success is None and isinstance(journal.outcome.get("success"), bool):
        success = journal.outcome["success"]
    result: Result | None = None if success is None else "success" if success else "fail"
    if success is None and (
        label := latest_label(journal.folder.absolute().parent.parent, str(journal.manifest["uuid"]))
    ):
        result = label.result
        success = None if result is None else result == "success"
    root = Path(dataset)
    with lock_dataset(root):
        recover(root)
        catalog = Catalog.read(root)
        if not catalog.info:
            require_empty(root)
        elif version not in (None, catalog.version):
            raise RecordingError(
                f"{root} is of version {catalog.version}, not {version}: publish to another folder, or convert it"
            )
        sidecars = {STREAMS: export_table(journal.folder), **contents}
        published = _publish(journal, catalog, (success, result), version or layout.DEFAULT_VERSION, sidecars)
    return replace(published, remark=verdict.text if verdict.state == "unsealed" else "")


def never_published(manifest: Mapping[str, object]) -> str:
    """Return why the run with this manifest may never be published, "" if it may be.

    The reason is a clause that continues a sentence which begins with the episode's name.
    """
    if manifest.get("kind") == IMPORTED:
        return "was imported: the dataset that it was imported with holds it, and can be converted, merged and split"
    if manifest.get("mode") != SIMULATED:
        return ""
    return (
        "is a run of mode sim: its actions went to a simulated robot alone, so that its pictures do not show "
        "what they did; it is no rollout and no demonstration"
    )


def _discarded(journal: FinishedEpisode) -> str:
    """Return a sentence that says who discarded the episode; "" if it is not discarded."""
    label = latest_label(journal.folder.absolute().parent.parent, str(journal.manifest["uuid"]))
    if label is None or not label.discarded:
        return ""
    return f"was discarded by {label.by}: what is discarded is never published"


def _require_publishable(journal: FinishedEpisode, include_interrupted: bool) -> None:
    reason = never_published(journal.manifest) or _discarded(journal)
    if reason:
        raise RecordingError(f"{journal.folder} {reason}")
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
    for camera, loss in journal.episode.lost.items():
        raise RecordingError(
            f"{journal.folder}: the video of {camera} ends at row {loss['row']} of {journal.frames}: {loss['reason']}. "
            "A dataset has a picture of every camera in every row"
        )


def _publish(
    journal: FinishedEpisode,
    catalog: Catalog,
    outcome: tuple[bool | None, Result | None],
    version: str,
    sidecars: Mapping[str, bytes],
) -> Published:
    root, success = catalog.root, outcome[0]
    features = _features(journal, _with_success(journal, catalog, success))
    if catalog.info:
        features = without_later(features, catalog.features)
    catalog.require_same(journal.robot, journal.fps, features)
    catalog = catalog.with_info(journal.robot, journal.fps, features, version)
    index, created = _place(journal, catalog)
    line = catalog.line(index, [journal.task], journal.frames)
    entry = catalog.entry(line)
    sides = {sidecar_path(root, kind, journal.uuid): content for kind, content in sidecars.items()}
    files = [*(span.path for span in entry.videos.values()), *sides, entry.data]
    with Staging(root, index, files) as staging:
        for path, content in sides.items():
            staging.write(path, content)
        statistics = {}
        for camera in journal.cameras:
            key = video_key(camera)
            statistics[key] = _stage_video(journal, camera, staging.path(entry.videos[key].path))
        columns = position_columns(
            recorded_columns(journal, features),
            episode_index=index,
            first_index=catalog.first_index(index),
            task_index=catalog.task_index(journal.task),
            success=bool(success) if SUCCESS in features else None,
        )
        write_table(table(columns, features), staging.path(entry.data))
        statistics |= column_statistics(columns, features)
        catalog = catalog.with_episode(line, statistics, _eva(journal, columns, *outcome))
        staging.commit(catalog.documents_before_data(), catalog.documents_after_data())
    return Published(root, index, journal.frames, created)


def _with_success(journal: FinishedEpisode, catalog: Catalog, success: bool | None) -> bool:
    """Return True if a success column is published for the episode.

    An existing dataset decides this by its columns; a new dataset gets the column if the success is known.

    Raises: RecordingError if the dataset has the column and the success is not known.
    """
    if not catalog.info:
        return success is not None
    has_success = SUCCESS in catalog.features
    if has_success and success is None:
        raise RecordingError(
            f"{catalog.root} says of every episode whether it succeeded ({SUCCESS}), of {journal.folder} "
            "that is not known: give --success or --failure"
        )
    return has_success


def _features(journal: FinishedEpisode, with_success: bool) -> declared.Features:
    columns = column_features(journal, with_success)
    leading = {key: columns.pop(key) for key in ("observation.state", "action")}
    videos = {
        video_key(camera): declared.video(
            height, width, journal.fps, codec_of(journal.episode.videos[camera]), PIXELS
        )
        for camera, (height, width) in journal.cameras.items()
    }
    return leading | videos | columns


def _place(journal: FinishedEpisode, catalog: Catalog) -> tuple[int, bool]:
    """Return the index for the episode, and whether it is new in the dataset.

    Raises:
        RecordingError: Its length has changed, which would shift the rows of later episodes.
    """
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


def _stage_video(journal: FinishedEpisode, camera: str, staged: Path) -> Statistic:
    source = journal.episode.videos[camera]
    facts = remux(source, staged, journal.frames, journal.fps)
    expected = VideoFacts(*journal.cameras[camera], facts.codec, PIXELS)
    if facts != expected:
        raise RecordingError(f"{source} is {facts}, the manifest promises {expected}")
    return video_statistic(staged, journal.frames)


def _eva(
    journal: FinishedEpisode, columns: Columns, success: bool | None, result: Result | None
) -> dict[str, Any]:
    """Return EVA Web's own line about the episode: facts that have no field in LeRobot's files, e.g. a partial
    success.
    """
    manifest = journal.manifest
    keys = ("station", "kind", "mode", "strategy", "started_wall", "configuration_hash", "versions")
    return {
        "uuid": journal.uuid,
        "frames": journal.frames,
        "task": journal.task,
        **{key: manifest[key] for key in keys if key in manifest},
        "simulated": bool(simulated_bench(manifest)),
        "outcome": dict(journal.outcome),
        "success": success,
        "result": result,
        "eef_state": _provenance(columns, "eef_measured", "measured", "forward kinematics"),
        "eef_action": _provenance(columns, "eef_action_reported", "reported", "forward kinematics"),
    }


def _provenance(columns: Mapping[str, NDArray[np.generic]], flag: str, true: str, false: str) -> str | None:
    """Return the source of the poses: `true` or `false` by the flag column, "mixed" if it differs by row.

    None if there is no such flag column.
    """
    if flag not in columns:
        return None
    flags = columns[flag]
    return true if flags.all() else "mixed" if flags.any() else false
