"""Services that write the rows of episodes; the folders are authoritative, and reconcile derives rows from them."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime, timedelta
from typing import Any
from uuid import UUID

from django.db import transaction
from django.db.models import Q
from django.db.models.functions import Now
from django.utils import timezone

from evaweb.core.errors import Conflict, EvaError
from evaweb.episodes.archive import archived_at
from evaweb.episodes.exports import TABLE, ExportFormat, exported
from evaweb.episodes.folders import data_dir, journal_folder, preview_folder
from evaweb.episodes.manifest import CLOSED, RecordedEpisode, read_recorded_episode
from evaweb.episodes.models import Episode, EpisodeMode, EpisodeStatus
from evaweb.jobs.models import Job
from evaweb.jobs.services import enqueue
from evaweb.stations.models import Station, StationKey
from runtime.core.sentences import Pattern
from runtime.recording.base import IMPORTED
from runtime.recording.files import RecordingError
from runtime.recording.outcome_seal import OUTCOME
from runtime.recording.quarantine import marked_damage

log = logging.getLogger(__name__)
_NO_EPISODE_EXPECTED_UUID = Pattern(
    "episodes.services.no_episode_expected_uuid",
    "{given!r} is no episode: expected its uuid",
)
_ANOTHERS = Pattern(
    "episodes.services.anothers",
    "episode {uuid} is of {owner}: {station} says nothing of it",
)

APPEARS_WITHIN = timedelta(seconds=60)  # time until the folder of an announced episode appears


@transaction.atomic
def record_opened(
    *,
    station: Station,
    uuid: UUID | str,
    kind: str = "rollout",
    mode: str = "",
    task: str = "",
    checkpoint: str = "",
    operator: str = "",
) -> Episode:
    """Create the row of an episode that the station has begun to record; an existing row is unchanged."""
    episode, _ = Episode.objects.get_or_create(
        uuid=_uuid(uuid),
        defaults={
            "station": station,
            "kind": kind,
            "mode": mode,
            "task": task,
            "robot": station.robot,
            "checkpoint": checkpoint,
            "operator": operator,
            "started_at": timezone.now(),
        },
    )
    _require_own(station, episode.pk)
    return episode


def _require_own(station: Station, uuid: UUID) -> None:
    """Raise Conflict for another station's episode: a compromised computer may affect only its own."""
    foreign = Episode.objects.exclude(station=station).select_related("station").filter(uuid=uuid).first()
    if foreign is not None:
        raise Conflict(_ANOTHERS(uuid=uuid, owner=foreign.station.name, station=station.name))


def record_closed(*, station: Station, data: Mapping[str, Any]) -> Episode:
    """Read an episode that the station reports as closed, and queue its preview.

    `data` are the data of the runtime's event, with the keys uuid, status, reason, rows, error and waits. If the folder
    is damaged or not on this machine, the values of the event are stored. Raises: EvaError for an invalid uuid, or
    another station's episode.
    """
    uuid = _uuid(data.get("uuid"))
    _require_own(station, uuid)
    try:
        episode = sync_episode(uuid=uuid, station=station)
        if data.get("waits") and episode.status == EpisodeStatus.RECORDING:
            episode.reason = f"its end waits for room on the disk: {data.get('reason')}"
            episode.save(update_fields=["reason"])
        return episode
    except RecordingError as error:
        log.warning("episode %s: %s", uuid, error)
        status, rows = data.get("status"), data.get("rows")
        facts = {
            "status": EpisodeStatus(status) if status in CLOSED else EpisodeStatus.FAILED,
            "reason": f"{data.get('reason') or 'no reason was given'} ({error})",
            "frames": rows if isinstance(rows, int) and rows > 0 else 0,
        }
        if station_elsewhere(station) and not journal_folder(uuid).exists():
            facts |= {"reason": str(data.get("reason") or ""), "away_since": timezone.now()}
    with transaction.atomic():
        episode, _ = Episode.objects.update_or_create(
            uuid=uuid, defaults=facts, create_defaults={"station": station, "robot": station.robot, **facts}
        )
    return episode


@transaction.atomic
def forget_unopened(*, station: Station, uuid: UUID | str) -> None:
    """Delete the row of an announced episode that could not be opened, unless it has a folder or a trial."""
    announced = station.episodes.filter(uuid=_uuid(uuid), status=EpisodeStatus.RECORDING, trial=None)
    if not journal_folder(_uuid(uuid)).exists():
        announced.delete()


@transaction.atomic
def create_missing_episode(*, station: Station, uuid: UUID, **facts: Any) -> Episode:
    """Create the row of an episode that other records refer to although its folder is gone."""
    episode, _ = Episode.objects.get_or_create(
        uuid=uuid,
        defaults={"station": station, "robot": station.robot, "status": EpisodeStatus.MISSING, **facts},
    )
    return episode


@transaction.atomic
def sync_episode(*, uuid: UUID, station: Station | None = None) -> Episode:
    """Update the episode's row from its folder, and queue a preview if there is something to play.

    Raises: RecordingError if the folder is absent or damaged, or if its outcome file is not the one with which the
    recording was closed. The row is then unchanged, except that a recording with another outcome file is verified again
    soon.
    """
    recorded = read_recorded_episode(journal_folder(uuid))
    row = Episode.objects.filter(uuid=uuid, status__in=CLOSED).first()
    if row is not None and (reason := outcome_change(row, recorded.facts.get("seal"))):
        Episode.objects.filter(uuid=uuid).update(verified_at=None)
        raise RecordingError(f"{journal_folder(uuid)}: {OUTCOME} {reason}")
    facts = dict(recorded.facts) | {
        "previewed_at": _previewed_at(uuid),
        "damage": marked_damage(data_dir(), str(uuid)),
        "away_since": None,
        "archived_at": archived_at(uuid),
    }
    episode, _ = Episode.objects.update_or_create(
        uuid=uuid,
        defaults=facts,
        create_defaults={"station": station or _station_of(recorded), **facts},
    )
    if episode.status in CLOSED and episode.frames and episode.cameras and episode.previewed_at is None:
        request_preview(episode=episode)
    if episode.smoothness is None and episode.smoothness_detail is not None:
        episode.smoothness_detail = None  # measure again: missing files may be there now
        episode.save(update_fields=["smoothness_detail"])
    return episode


def outcome_change(row: Episode, seal: str | None) -> str:
    """Return how the outcome file of a closed episode has changed, as words that follow its name; "" if unchanged.

    `seal` is the seal in the present file: None if the file is absent, "" if it has no seal.
    """
    if seal is None:
        return f"is absent, though the recording was closed as {row.status}"
    if row.seal and seal != row.seal:
        return (
            "is not the one with which the recording was closed: whether its files are unchanged is unknown"
        )
    return ""


def trial_changed(*, uuid: UUID) -> None:
    """Mark the episode's trial as changed, because displayed data of the episode has changed."""
    trials: Any = Episode._meta.get_field("trial").related_model
    trials._default_manager.filter(episode=uuid).update(changed_at=Now())


def request_preview(*, episode: Episode) -> Job:
    """Queue the preview of an episode."""
    return enqueue(kind="preview", key=f"preview:{episode.uuid}", args={"uuid": str(episode.uuid)})


def request_storing(*, uuid: UUID) -> Job:
    """Queue the transfer of an episode's preview videos to the lab's store."""
    return enqueue(kind="store", key=f"store:{uuid}", args={"uuid": str(uuid)})


def request_archive(*, uuid: UUID) -> Job:
    """Queue the move of an episode's camera files to the lab's store."""
    return enqueue(kind="archive", key=f"archive:{uuid}", args={"uuid": str(uuid)})


def request_export(*, episode: Episode, wanted: ExportFormat = TABLE) -> Job:
    """Queue the export of an episode to that format; an existing table is kept."""
    uuid = episode.uuid
    return enqueue(kind=wanted.job, key=wanted.job_key(uuid), args=wanted.job_args(uuid))


def request_smoothness(*, most: int) -> int:
    """Queue smoothness measurements of closed runs, and return the number of queued runs.

    At most `most` runs are queued, oldest first. A run whose measurement was requested before is not queued again.
    """
    rows = Episode.objects.filter(
        status__in=CLOSED, kind="rollout", frames__gt=0, smoothness_detail__isnull=True
    )
    episodes = list(rows.filter(away_since=None).order_by("created_at")[:most])
    for episode in episodes:
        with transaction.atomic():
            # Requested once, whatever its outcome: a failed job remains visible and can be retried.
            Episode.objects.filter(pk=episode.pk).update(smoothness_detail={})
            enqueue(kind="smoothness", key=f"smoothness:{episode.uuid}", args={"uuid": str(episode.uuid)})
    return len(episodes)


def request_publish(*, episode: Episode, version: str = "") -> Job | None:
    """Queue the publication of an episode; if it is published already, it is published again with the current score.

    `version` is that of a new dataset, "" for the default. Returns None for a run with a simulated robot, which is
    never published.
    """
    if episode.mode == EpisodeMode.SIM:
        return None
    args = {"uuid": str(episode.uuid)} | ({"version": version} if version else {})
    return enqueue(kind="publish", key=f"publish:{episode.uuid}", args=args)


def close_unheard_episodes() -> int:
    """Close the rows of episodes whose recordings were closed without an event; return the number of these rows.

    For example, a repair closes a recording without an event.
    """
    closed = 0
    for uuid in Episode.objects.filter(status=EpisodeStatus.RECORDING).values_list("uuid", flat=True):
        if (journal_folder(uuid) / "outcome.json").exists():
            closed += not sync_problem(uuid)
    return closed


def mark_missing() -> int:
    """Mark every row without a folder as missing; return the number of all missing episodes."""
    fresh = Q(status=EpisodeStatus.RECORDING, created_at__gt=Now() - APPEARS_WITHIN)
    expected = Episode.objects.exclude(fresh).exclude(status=EpisodeStatus.MISSING).filter(away_since=None)
    # A recording on another computer is there until it is closed, and then in transfer.
    elsewhere = StationKey.objects.filter(withdrawn_at=None).values("station")
    expected = expected.exclude(status=EpisodeStatus.RECORDING, station__in=elsewhere)
    for uuid in expected.values_list("uuid", flat=True):
        if not journal_folder(uuid).is_dir():
            Episode.objects.filter(uuid=uuid).update(status=EpisodeStatus.MISSING)
    return Episode.objects.filter(status=EpisodeStatus.MISSING).count()


def request_exports(*, uuids: Iterable[UUID]) -> int:
    """Queue the export of episodes without a table; return their number. Damaged ones are skipped."""
    count = 0
    for episode in Episode.objects.filter(uuid__in=list(uuids), status__in=CLOSED):
        try:
            missing = exported(episode.uuid) is None
        except RecordingError as error:
            log.warning("episode %s is not exported: %s", episode.uuid, error)
            continue
        if missing:
            request_export(episode=episode)
            count += 1
    return count


def sync_problem(uuid: UUID) -> str:
    """Update a row from its folder; return the problem as a message, "" on success."""
    try:
        sync_episode(uuid=uuid)
    except RecordingError as error:
        open_rows = Episode.objects.filter(uuid=uuid, status=EpisodeStatus.RECORDING)
        if (journal_folder(uuid) / "outcome.json").exists():
            open_rows.update(status=EpisodeStatus.FAILED, reason=str(error))
        return str(error)
    return ""


def _previewed_at(uuid: UUID) -> datetime | None:
    folder = preview_folder(uuid)
    return datetime.fromtimestamp(folder.stat().st_mtime, UTC) if folder.is_dir() else None


def _station_of(recorded: RecordedEpisode) -> Station:
    """Return the station of a recording; create it if it is not in the database."""
    return get_or_create_station(
        name=recorded.station or "unknown",
        robot=recorded.facts.get("robot", ""),
        simulated=recorded.simulated,
        source=f"episode {recorded.uuid}",
        active=recorded.facts["kind"] != IMPORTED,  # imported episodes have no actual station
    )


def get_or_create_station(
    *, name: str, robot: str, simulated: bool, source: str, active: bool = True
) -> Station:
    """Return the station of that name; create it with the given values if it does not exist.

    `source` names where these values are from, for the log.
    """
    station, created = Station.objects.get_or_create(
        name=name, defaults={"robot": robot, "simulated": simulated, "title": name, "active": active}
    )
    if created and active:
        log.warning("station %s was not in the database: made from %s", name, source)
    return station


def station_elsewhere(station: Station) -> bool:
    """Return True if the station runs on another computer, from which its episodes are transferred."""
    return StationKey.objects.filter(station=station, withdrawn_at=None).exists()


def _uuid(value: object) -> UUID:
    try:
        return value if isinstance(value, UUID) else UUID(str(value))
    except ValueError:
        raise EvaError(_NO_EPISODE_EXPECTED_UUID(given=value)) from None
