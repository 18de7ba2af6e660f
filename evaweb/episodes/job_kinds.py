"""Jobs of episodes: preview, export, smoothness, publish, scrub, reconcile; and their periodic tasks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import UUID

from django.db.models.functions import Now
from django.utils import timezone

from evaweb.core.object_stores import the_store
from evaweb.episodes import services, verification
from evaweb.episodes.archive import NotArchived, lock_recording, put_away, remove_unused, use_videos
from evaweb.episodes.arriving import ingest_arrived, whereabouts
from evaweb.episodes.dataset_sidecars import write_sidecars
from evaweb.episodes.exports import remove_old_mcap, write_mcap
from evaweb.episodes.folders import data_dir, datasets_dir, journal_folder, preview_folder, scores_file
from evaweb.episodes.manifest import read_recorded_episode
from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.episodes.preview import make_preview
from evaweb.episodes.publishing import dataset_name, success_of
from evaweb.episodes.reconcile import reconcile
from evaweb.episodes.smoothness import Smoothness, smoothness_in
from evaweb.episodes.videos import put_videos, unstored
from evaweb.jobs.kinds import JobContext, job_kind, periodic_task, startup_task
from evaweb.jobs.services import enqueue
from runtime.datasets.publishing import never_published, publish
from runtime.recording.export import write_export
from runtime.recording.files import RecordingError
from runtime.recording.integrity import DamagedError
from runtime.recording.labels import latest_label

_AT_ONCE = 20  # jobs queued per call of a periodic task


@job_kind("preview")
def preview(work: JobContext) -> Mapping[str, Any]:
    """Make the preview of the episode.

    The job has one argument: `uuid`, the episode's.
    """
    episode = Episode.objects.get(uuid=UUID(work.args["uuid"]))
    use_videos(work, episode.uuid)
    frames = make_preview(journal_folder(episode.uuid), preview_folder(episode.uuid), work.report_progress)
    Episode.objects.filter(uuid=episode.uuid).update(previewed_at=timezone.now())
    if the_store() is not None:
        services.request_storing(uuid=episode.uuid)
    return {"frames": frames}


@job_kind("store")
def store_videos(work: JobContext) -> Mapping[str, Any]:
    """Move the videos of a preview to the lab's store, from which they are then played.

    The job has one argument: `uuid`, the episode's.
    """
    return {"videos": put_videos(UUID(work.args["uuid"]))}


@job_kind("archive")
def archive_recording(work: JobContext) -> Mapping[str, Any]:
    """Move the camera files of a closed recording to the lab's store.

    The job has one argument: `uuid`, the episode's. A recording that may not be moved stays as it is.
    """
    uuid = UUID(work.args["uuid"])
    lock_recording(work, uuid)
    try:
        return {"archived": True, "removed": put_away(uuid, work.report_progress, held=True)}
    except NotArchived as refused:
        return {"archived": False, "why": str(refused)}
    except DamagedError as error:
        verification.record_verification(error.verdict)
        return {"archived": False, "why": str(error)}


@periodic_task("recordings to be archived")
def find_archivable() -> int:
    """Queue the move of old recordings to the store if the workers are idle; return their number."""
    return len(verification.request_archives())


@periodic_task("videos that were brought back")
def remove_unused_videos() -> int:
    """Remove videos of archived recordings that no job has used for an hour; return the number of recordings."""
    return remove_unused()


@startup_task("videos to be stored")
def store_at_start() -> None:
    """Queue videos that were made while there was no store or it was unavailable."""
    for uuid in unstored():
        services.request_storing(uuid=uuid)


@job_kind("export")
def export_episode(work: JobContext) -> Mapping[str, Any]:
    """Write the three action streams as one Parquet table, unless the station has written it.

    The job has one argument: `uuid`, the episode's.
    """
    path = write_export(journal_folder(UUID(work.args["uuid"])), data_dir())
    return {"file": str(path.relative_to(data_dir())), "bytes": path.stat().st_size}


@job_kind("mcap")
def export_episode_as_mcap(work: JobContext) -> Mapping[str, Any]:
    """Write the episode as one MCAP file, which is kept for a day.

    The job has two arguments: `uuid`, the episode's, and `pictures` (runtime.interop.mcap_export.PICTURES).
    """
    uuid = UUID(work.args["uuid"])
    use_videos(work, uuid)
    path, summary = write_mcap(uuid, work.args["pictures"], work.report_progress)
    return {
        "file": str(path.relative_to(data_dir())),
        "bytes": summary.bytes,
        "messages": summary.messages,
        "coded_again": dict(summary.coded_again),
        "moved": dict(summary.moved),
        "left_out": list(summary.left_out),
    }


@periodic_task("MCAP files")
def remove_mcap_files() -> int:
    """Remove MCAP files that were made more than a day ago; return their number."""
    return remove_old_mcap()


@job_kind("smoothness")
def measure_smoothness(work: JobContext) -> Mapping[str, Any]:
    """Measure the smoothness of the robot's motion and store it, or the reason why it is unknown.

    The job has one argument: `uuid`, the episode's.
    """
    uuid = UUID(work.args["uuid"])
    try:
        smoothness = smoothness_in(journal_folder(uuid))
    except RecordingError as error:
        smoothness = Smoothness(None, None, {}, str(error))
    Episode.objects.filter(uuid=uuid).update(
        smoothness=smoothness.measured,
        smoothness_commanded=smoothness.commanded,
        smoothness_detail={
            "arms": {name: dict(arm) for name, arm in smoothness.arms.items()},
            "why": smoothness.why,
        },
    )
    services.trial_changed(uuid=uuid)
    return {"smoothness": smoothness.measured, "why": smoothness.why}


@job_kind("publish")
def publish_episode(work: JobContext) -> Mapping[str, Any]:
    """Write the episode into its dataset, labelled with the success in its newest score.

    The job has the argument `uuid`, the episode's, and optionally `version`, the format version if the dataset is new.
    An interrupted episode is published only if it has a score. A discarded episode is never published.
    """
    episode = Episode.objects.select_related("station").get(uuid=UUID(work.args["uuid"]))
    folder = journal_folder(episode.uuid)
    if not folder.exists():
        reason = "there is no folder of it: nothing of its run is on this disk"
        if episode.away_since is not None:
            reason = f"{whereabouts(episode)} It is published when it is."
        return {"published": False, "why": reason}
    try:
        return _published(work, episode, folder)
    except RecordingError:
        use_videos(work, episode.uuid)
        verdict = verification.compare_with_row(episode, verification.verify_with_store(episode.uuid))
        if verdict.state != "damaged":
            raise
        verification.record_verification(verdict)
        return {"published": False, "why": str(DamagedError(verdict))}


def _published(work: JobContext, episode: Episode, folder: Path) -> Mapping[str, Any]:
    recorded = read_recorded_episode(folder)
    if recorded.closed and (changed := services.outcome_change(episode, recorded.facts["seal"])):
        raise RecordingError(f"{folder}: outcome.json {changed}")
    if recorded.closed and not recorded.facts["frames"]:
        return {"published": False, "why": "it has no rows: its run ended before the first"}
    reason = never_published({name: recorded.facts.get(name) for name in ("mode", "kind")})
    if reason:
        return {"published": False, "why": f"it {reason}"}
    label = latest_label(data_dir(), str(episode.uuid))
    if label is not None and label.discarded:
        return {"published": False, "why": f"it was discarded by {label.by}"}
    success = success_of(scores_file(episode.uuid))
    if success is None and recorded.facts["status"] in (EpisodeStatus.INTERRUPTED, EpisodeStatus.FAILED):
        return {"published": False, "why": f"it is {recorded.facts['status']} and has no score"}
    simulated = recorded.simulated or episode.station.simulated
    name = dataset_name(recorded, scored=success is not None, simulated=simulated)
    work.report_progress(f"into {name}")
    dataset_folder = datasets_dir() / name
    use_videos(work, episode.uuid, [dataset_folder.relative_to(data_dir()).as_posix()])
    with TemporaryDirectory() as scratch:
        placed = publish(
            folder,
            dataset_folder,
            success=success,
            include_interrupted=success is not None,
            version=work.args.get("version"),
            sides=write_sidecars(episode.uuid, Path(scratch)),
        )
    dataset = str(placed.dataset.relative_to(data_dir()))
    Episode.objects.filter(uuid=episode.uuid).update(
        dataset=dataset, dataset_index=placed.episode_index, published_at=Now()
    )
    return {
        "published": True,
        "dataset": dataset,
        "index": placed.episode_index,
        "frames": placed.frames,
        "success": success,
        "created": placed.created,
        **({"remark": placed.remark} if placed.remark else {}),
    }


@job_kind("scrub")
def scrub(work: JobContext) -> Mapping[str, Any]:
    """Verify the recordings that were verified longest ago against their digests."""
    return verification.scrub_due(work)


@job_kind("reconcile")
def reconcile_all(work: JobContext) -> Mapping[str, Any]:
    """Synchronise the database with the data folder."""
    report = reconcile()
    return {
        "episodes": report.episodes,
        "made": report.made,
        "missing": report.missing,
        "published": report.published,
        "restored": report.restored,
        "problems": list(report.problems),
    }


@startup_task("reconcile")
def reconcile_at_start() -> None:
    """Reconcile the database with changes that were made on the disk while no worker was running."""
    enqueue(kind="reconcile", key="reconcile", args={})


@periodic_task("closed recordings")
def find_closed_episodes() -> int:
    """Close the rows of episodes whose closing this web has missed.

    These are episodes that a station repaired, and episodes that a station closed while the web was not running.
    """
    return services.close_unheard_episodes()


@periodic_task("arrived recordings")
def look_for_arrived() -> int:
    """Add rows of episodes that arrived from stations on other computers; return the number of these episodes."""
    return ingest_arrived()


@periodic_task("recordings to be verified")
def find_unverified_episodes() -> bool:
    """Queue the verification of old recordings if the workers are idle."""
    return verification.request_scrub() is not None


@periodic_task("runs to be measured")
def find_unmeasured_episodes() -> int:
    """Queue the measurement of newly closed runs."""
    return services.request_smoothness(most=_AT_ONCE)
