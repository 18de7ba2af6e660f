"""Changes to the rows of episodes; their folders are the authority, and reconcile makes rows of them."""

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

from evaweb.episodes.exporting import exported, job_key
from evaweb.episodes.folders import data_dir, journal_folder, preview_folder
from evaweb.episodes.manifest import CLOSED, RecordedEpisode, read_recorded_episode
from evaweb.episodes.models import Episode, EpisodeMode, EpisodeStatus
from evaweb.errors import Conflict, EvaError
from evaweb.jobs.models import Job
from evaweb.jobs.services import enqueue
from evaweb.stations.models import Station, StationKey
from runtime.core.sentences import Pattern
from runtime.recording.base import IMPORTED
from runtime.recording.files import RecordingError
from runtime.recording.quarantine import marked_damage
from runtime.recording.sealing import OUTCOME

log = logging.getLogger(__name__)
_NO_EPISODE_EXPECTED_UUID = Pattern(
    "episodes.services.no_episode_expected_uuid",
    "{given!r} is no episode: expected its uuid",
)
_ANOTHERS = Pattern(
    "episodes.services.anothers",
    "episode {uuid} is of {owner}: {station} says nothing of it",
)

APPEARS_WITHIN = timedelta(seconds=60)  # the folder of an episode that was announced


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
    """The station has begun to record; the row that is there already stays as it is."""
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
    """A station on another computer is believed of its own episodes alone, whatever its key or computer came to."""
    other = Episode.objects.exclude(station=station).select_related("station").filter(uuid=uuid).first()
    if other is not None:
        raise Conflict(_ANOTHERS(uuid=uuid, owner=other.station.name, station=station.name))


def record_closed(*, station: Station, data: Mapping[str, Any]) -> Episode:
    """The station says that an episode is on disk: read it there, and ask for its preview.

    `data` is that of the runtime's event: uuid, status, reason, rows, error, waits. Where the folder is not on this
    machine, or damaged, the event's own words are kept. EvaError where it names no episode, or another station's.
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
    """Forget an episode that was announced and could not be opened; one that has a folder, or a trial, stays."""
    announced = station.episodes.filter(uuid=_uuid(uuid), status=EpisodeStatus.RECORDING, trial=None)
    if not journal_folder(_uuid(uuid)).exists():
        announced.delete()


@transaction.atomic
def create_missing_episode(*, station: Station, uuid: UUID, **facts: Any) -> Episode:
    """The row of an episode that others still know of, although its folder is gone."""
    episode, _ = Episode.objects.get_or_create(
        uuid=uuid,
        defaults={"station": station, "robot": station.robot, "status": EpisodeStatus.MISSING, **facts},
    )
    return episode


@transaction.atomic
def sync_episode(*, uuid: UUID, station: Station | None = None) -> Episode:
    """Make the row say what the folder says, and ask for a preview where there is something to play.

    RecordingError where the folder is absent or damaged, or is not that of the recording that was closed: then the row
    stays as it is, and is verified next.
    """
    recorded = read_recorded_episode(journal_folder(uuid))
    row = Episode.objects.filter(uuid=uuid, status__in=CLOSED).first()
    if row is not None and (why := outcome_change(row, recorded.facts.get("seal"))):
        Episode.objects.filter(uuid=uuid).update(verified_at=None)
        raise RecordingError(f"{journal_folder(uuid)}: {OUTCOME} {why}")
    facts = dict(recorded.facts) | {
        "previewed_at": _previewed_at(uuid),
        "damage": marked_damage(data_dir(), str(uuid)),
        "away_since": None,
    }
    episode, _ = Episode.objects.update_or_create(
        uuid=uuid,
        defaults=facts,
        create_defaults={"station": station or _station_of(recorded), **facts},
    )
    if episode.status in CLOSED and episode.frames and episode.cameras and episode.previewed_at is None:
        request_preview(episode=episode)
    if episode.smoothness is None and episode.smoothness_detail is not None:
        episode.smoothness_detail = None  # what the folder lacked may be there now
        episode.save(update_fields=["smoothness_detail"])
    return episode


def outcome_change(row: Episode, seal: str | None) -> str:
    """Change of the outcome of a closed row, in words that follow its name; "" where it is the same.

    `seal` is that of the one that is there now: None where there is none, "" where it has none.
    """
    if seal is None:
        return f"is absent, though the recording was closed as {row.status}"
    if row.seal and seal != row.seal:
        return "is not the one with which the recording was closed: nobody can say whether its files are as they were"
    return ""


def trial_changed(*, uuid: UUID) -> None:
    """Mark the episode's trial as changed, where it has one: what is shown of it has."""
    trials: Any = Episode._meta.get_field("trial").related_model
    trials._default_manager.filter(episode=uuid).update(changed_at=Now())


def request_preview(*, episode: Episode) -> Job:
    """Have the worker make what a browser can play."""
    return enqueue(kind="preview", key=f"preview:{episode.uuid}", args={"uuid": str(episode.uuid)})


def storing_asked(*, uuid: UUID) -> Job:
    """Have the worker put the videos of its preview into the lab's store."""
    return enqueue(kind="store", key=f"store:{uuid}", args={"uuid": str(uuid)})


def request_export(*, episode: Episode) -> Job:
    """Have the worker write its three streams as one table; it leaves one alone that is there."""
    return enqueue(kind="export", key=job_key(episode.uuid), args={"uuid": str(episode.uuid)})


def request_smoothness(*, most: int) -> int:
    """Have the worker measure closed runs not yet asked for, at most so many; how many."""
    rows = Episode.objects.filter(
        status__in=CLOSED, kind="rollout", frames__gt=0, smoothness_detail__isnull=True
    )
    found = list(rows.filter(away_since=None).order_by("created_at")[:most])
    for episode in found:
        with transaction.atomic():
            # Asked for once, however it ends: a job that failed is there to be seen and to be tried again.
            Episode.objects.filter(pk=episode.pk).update(smoothness_detail={})
            enqueue(kind="smoothness", key=f"smoothness:{episode.uuid}", args={"uuid": str(episode.uuid)})
    return len(found)


def request_publish(*, episode: Episode, version: str = "") -> Job | None:
    """Have the worker write the episode into its dataset, or write it anew with the score that counts now.

    `version` is that of a dataset that is new, "" for the usual one. None for a run with a simulated robot, which
    no dataset ever holds.
    """
    if episode.mode == EpisodeMode.SIM:
        return None
    args = {"uuid": str(episode.uuid)} | ({"version": version} if version else {})
    return enqueue(kind="publish", key=f"publish:{episode.uuid}", args=args)


def close_unheard_episodes() -> int:
    """Close rows of recordings that were closed unheard, as repair does; how many."""
    closed = 0
    for uuid in Episode.objects.filter(status=EpisodeStatus.RECORDING).values_list("uuid", flat=True):
        if (journal_folder(uuid) / "outcome.json").exists():
            closed += not sync_problem(uuid)
    return closed


def mark_missing() -> int:
    """Say of every row whose folder is gone that it is missing; how many there are now."""
    fresh = Q(status=EpisodeStatus.RECORDING, created_at__gt=Now() - APPEARS_WITHIN)
    known = Episode.objects.exclude(fresh).exclude(status=EpisodeStatus.MISSING).filter(away_since=None)
    # One that is recorded elsewhere is on that computer until it is closed, and on its way then.
    elsewhere = StationKey.objects.filter(withdrawn_at=None).values("station")
    known = known.exclude(status=EpisodeStatus.RECORDING, station__in=elsewhere)
    for uuid in known.values_list("uuid", flat=True):
        if not journal_folder(uuid).is_dir():
            Episode.objects.filter(uuid=uuid).update(status=EpisodeStatus.MISSING)
    return Episode.objects.filter(status=EpisodeStatus.MISSING).count()


def request_exports(*, uuids: Iterable[UUID]) -> int:
    """Have the worker export those that their station has not; how many. A damaged one has no table."""
    asked = 0
    for episode in Episode.objects.filter(uuid__in=list(uuids), status__in=CLOSED):
        try:
            missing = exported(episode.uuid) is None
        except RecordingError as error:
            log.warning("episode %s is not exported: %s", episode.uuid, error)
            continue
        if missing:
            request_export(episode=episode)
            asked += 1
    return asked


def sync_problem(uuid: UUID) -> str:
    """Read one folder into its row; the sentence that says why that cannot be, "" where it could."""
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
    """The station it was recorded at; one that is not known any more is known from it again."""
    return get_or_create_station(
        name=recorded.station or "unknown",
        robot=recorded.facts.get("robot", ""),
        simulated=recorded.simulated,
        source=f"episode {recorded.uuid}",
        active=recorded.facts["kind"] != IMPORTED,  # of those there is no bench
    )


def get_or_create_station(
    *, name: str, robot: str, simulated: bool, source: str, active: bool = True
) -> Station:
    """The station of that name; one that is not in the database any more is made from what `source` says."""
    station, made = Station.objects.get_or_create(
        name=name, defaults={"robot": robot, "simulated": simulated, "title": name, "active": active}
    )
    if made and active:
        log.warning("station %s was not in the database: made from %s", name, source)
    return station


def station_elsewhere(station: Station) -> bool:
    """True if it runs on a computer of its own, from where its episodes have to come."""
    return StationKey.objects.filter(station=station, withdrawn_at=None).exists()


def _uuid(given: object) -> UUID:
    try:
        return given if isinstance(given, UUID) else UUID(str(given))
    except ValueError:
        raise EvaError(_NO_EPISODE_EXPECTED_UUID(given=given)) from None
