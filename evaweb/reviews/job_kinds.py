"""Jobs of reviews: quality checks, and sidecars in datasets; and the periodic tasks that queue them."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any
from uuid import UUID

from django.db import transaction

from evaweb.episodes.archive import use_videos
from evaweb.episodes.folders import data_dir, journal_folder
from evaweb.episodes.models import Episode
from evaweb.jobs.kinds import JobContext, job_kind, periodic_task
from evaweb.jobs.services import enqueue
from evaweb.reviews import selectors, services
from evaweb.reviews.dataset_sidecars import review_lines, write_review_sidecars
from evaweb.reviews.models import Standing
from evaweb.reviews.record import bounds_file, report_file
from runtime.datasets.sidecars import attach_sidecar
from runtime.recording.files import read_json, to_json, write_atomic

if TYPE_CHECKING:
    from runtime.quality.report import Report
    from runtime.quality.settings import QualitySettings

AT_ONCE = 20  # jobs queued per call of a periodic task


@job_kind("quality")
def quality(work: JobContext) -> Mapping[str, Any]:
    """Check the quality of an episode and store the report.

    The job has one argument: `uuid`, the episode's.
    """
    # Imported late: web processes import this module but never run the job.
    from runtime.quality.settings import QualitySettings, read_settings

    episode = Episode.objects.get(uuid=UUID(work.args["uuid"]))
    bounds = bounds_file()
    settings = read_settings(bounds) if bounds.exists() else QualitySettings()
    use_videos(work, episode.uuid)
    work.report_progress("every frame and picture is looked at")
    report = _inspected(episode, settings).to_dict()
    path = report_file(episode.uuid)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, to_json(report, "the report"))
    services.record_quality(
        episode=episode, document=report, at=datetime.fromtimestamp(path.stat().st_mtime, UTC)
    )
    return {"clean": report["clean"], "worst": report["worst"], "counts": report["counts"]}


def _inspected(episode: Episode, settings: QualitySettings) -> Report:
    """Return the quality report of an episode.

    An imported episode is checked in its dataset: its own folder has other times, and re-encoded images.
    """
    from runtime.datasets.episode_uuids import uuids_of
    from runtime.quality.inspection import check_dataset_episode, check_episode

    folder = journal_folder(episode.uuid)
    imported = read_json(folder / "manifest.json").get("imported")
    if isinstance(imported, Mapping):
        dataset = data_dir() / (episode.dataset or str(imported["dataset"]))
        index = next((index for index, uuid in uuids_of(dataset).items() if uuid == str(episode.uuid)), None)
        if index is not None:
            return check_dataset_episode(
                dataset, index, settings, state=str(imported["state"]), robot=str(imported["robot"])
            )
    return check_episode(folder, settings)


@job_kind("sides")
def write_sidecars_job(work: JobContext) -> Mapping[str, Any]:
    """Attach reviews and annotations to the published episode.

    The job has one argument: `uuid`, the episode's.
    """
    episode = Episode.objects.get(uuid=UUID(work.args["uuid"]))
    if episode.dataset_index is None:
        return {"attached": False, "why": "it is in no dataset"}
    dataset = data_dir() / episode.dataset
    work.hold([episode.dataset])
    with TemporaryDirectory() as folder:
        paths = write_review_sidecars(episode.uuid, Path(folder))
        for kind in ("reviews", "annotations"):
            attach_sidecar(dataset, str(episode.uuid), kind, paths.get(kind))
    counts = {kind: len(lines) for kind, lines in review_lines(episode.uuid).items()}
    return {"attached": True, **counts}


@periodic_task("episodes to be checked")
def find_unchecked_episodes() -> int:
    """Queue checks of newly closed episodes."""
    episodes = list(selectors.unchecked_episodes()[:AT_ONCE])
    for episode in episodes:
        services.request_quality_check(episode=episode)
    return len(episodes)


@periodic_task("reviews to be published")
def find_outdated_sidecars() -> int:
    """Queue updates of the sidecars of published episodes that lack the newest reviews.

    A sidecar lacks them if a review changed after it was written, or if the episode was published after it was written.
    """
    rows = list(selectors.outdated_episodes()[:AT_ONCE])
    for standing in rows:
        with transaction.atomic():
            # Requested once, whatever its outcome: a failed job remains visible and can be retried.
            upto = max(standing.changed_at, standing.episode.published_at)
            Standing.objects.filter(pk=standing.pk).update(attached_at=upto)
            uuid = str(standing.episode_id)
            enqueue(kind="sides", key=f"sides:{uuid}", args={"uuid": uuid})
    return len(rows)
