"""Periodic verification of recordings in small portions, those verified longest ago first."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import datetime, timedelta
from itertools import islice
from pathlib import Path
from typing import Any
from uuid import UUID

from django.conf import settings
from django.db.models import F, Q, QuerySet
from django.utils import timezone

from evaweb.core.object_stores import StoreError
from evaweb.episodes.archive import archived_at, bring_again, use_videos
from evaweb.episodes.folders import data_dir, journal_folder
from evaweb.episodes.manifest import CLOSED, read_recorded_episode
from evaweb.episodes.models import Episode
from evaweb.episodes.services import outcome_change, request_archive
from evaweb.jobs.kinds import JobContext
from evaweb.jobs.models import Job, JobStatus
from evaweb.jobs.services import enqueue
from runtime.recording.base import IMPORTED
from runtime.recording.files import RecordingError
from runtime.recording.integrity import Damage, IntegrityCheck
from runtime.recording.outcome_seal import MANIFEST, OUTCOME, OUTCOME_COPY
from runtime.recording.quarantine import marked_damage, update_mark
from runtime.recording.scrub import verify_episode

log = logging.getLogger(__name__)

AGAIN_AFTER = timedelta(days=30)
OLD_AFTER = timedelta(hours=1)  # a new recording is verified at its publication
LATE_AFTER = timedelta(days=1)
_PAUSE = timedelta(hours=1)  # after a failed job
_ARCHIVED_AT_ONCE = 5
_MOST_FAILED = 3  # in a row; then the store is away, and it is not a recording that it has lost
MOST_EPISODES, MOST_BYTES = 100, 1 << 30  # limits per job, because other jobs wait meanwhile


def request_scrub() -> Job | None:
    """Queue the verification of due recordings if the workers are idle; return the job, else None."""
    archived = not _failed_lately(
        "scrub"
    )  # perhaps the store is away: meanwhile the other recordings are verified
    if _anything_queued() or not _due(archived).exists():
        return None
    return enqueue(kind="scrub", key="scrub", args={} if archived else {"archived": False})


def request_archives() -> list[Job]:
    """Queue the move of a few old recordings to the lab's store if the workers are idle; return the jobs.

    Each is asked for again only a month after a job has left it as it is or was cancelled, and a day after one has
    failed. After a job has failed, none is for an hour.
    """
    if settings.EVA_ARCHIVE_DAYS is None or _anything_queued() or _failed_lately("archive"):
        return []
    now = timezone.now()
    limit = now - timedelta(days=settings.EVA_ARCHIVE_DAYS)
    here = Episode.objects.filter(status__in=CLOSED, damage=[], away_since=None, archived_at=None)
    rows = here.filter(previewed_at__isnull=False, verified_at__isnull=False, started_at__lt=limit)
    rows = rows.exclude(kind=IMPORTED).exclude(seal="")
    uuids = rows.order_by("started_at").values_list("uuid", flat=True)
    recent = _recently_moved(now)
    # Those that stay must not hide the ones behind them.
    waiting = islice((uuid for uuid in uuids.iterator() if f"archive:{uuid}" not in recent), MOST_EPISODES)
    old = (uuid for uuid in waiting if _closed_before(uuid, limit))
    return [request_archive(uuid=uuid) for uuid in list(islice(old, _ARCHIVED_AT_ONCE))]


def _recently_moved(now: datetime) -> set[str]:
    """Return the keys of jobs that have not archived their recording, and need not be asked for again yet."""
    left = Q(status=JobStatus.DONE, result__archived=False) | Q(cancelled_by__isnull=False)
    failed = Q(status=JobStatus.FAILED, finished_at__gt=now - LATE_AFTER)
    jobs = Job.objects.filter(kind="archive", finished_at__gt=now - AGAIN_AFTER)
    return set(jobs.filter(left | failed).values_list("key", flat=True))


def _closed_before(uuid: UUID, limit: datetime) -> bool:
    try:
        ended = read_recorded_episode(journal_folder(uuid)).ended_at
    except RecordingError:
        return False  # the next verification finds out why
    return ended is not None and ended < limit


def _anything_queued() -> bool:
    return Job.objects.filter(status__in=(JobStatus.QUEUED, JobStatus.RUNNING)).exists()


def _failed_lately(kind: str) -> bool:
    failed = Job.objects.filter(kind=kind, status=JobStatus.FAILED, cancelled_by=None)
    return failed.filter(finished_at__gt=timezone.now() - _PAUSE).exists()


def scrub_due(work: JobContext) -> Mapping[str, Any]:
    """Verify the next due recordings and store each result immediately.

    Camera files that are in the lab's store are brought back for it. After the store has failed for several
    recordings in a row, other archived recordings wait.

    Returns: Number of recordings by result.
    Raises: StoreError or RecordingError after all others, if videos could not be brought back.
    """
    archived = bool(work.args.get("archived", True))
    failed: Exception | None = None
    in_a_row = 0
    counts = dict.fromkeys(("sound", "damaged", "unsealed", "open"), 0)
    damaged, problems, read = [], [], 0
    for uuid in _next(archived):
        if read >= MOST_BYTES:
            break
        is_archived = archived_at(uuid) is not None
        if is_archived and in_a_row >= _MOST_FAILED:
            continue
        work.report_progress(f"{sum(counts.values())} verified, {len(damaged)} damaged")
        try:
            use_videos(work, uuid)
        except (StoreError, RecordingError) as error:
            failed = error
            in_a_row += isinstance(error, StoreError)
            continue
        in_a_row = 0 if is_archived else in_a_row
        try:
            verdict = record_verification(verify_with_store(uuid))
        except StoreError as error:
            failed = error
            in_a_row += 1
            continue
        except RecordingError as error:
            problems.append(str(error))
            Episode.objects.filter(uuid=uuid).update(verified_at=timezone.now())
            continue
        counts[verdict.state] += 1
        read += verdict.bytes
        damaged += [{"uuid": str(uuid), "why": verdict.text}] if verdict.state == "damaged" else []
    if failed is not None:
        raise failed
    return {**counts, "bytes": read, "found": damaged, "problems": problems}


def record_verification(verdict: IntegrityCheck) -> IntegrityCheck:
    """Store the result of an episode's verification on disk and in the episode's database row.

    Returns:
        The result after the comparison with the database row (see `compare_with_row`).
    """
    row = Episode.objects.filter(uuid=UUID(verdict.path.name)).first()
    verdict = compare_with_row(row, verdict) if row else verdict
    if verdict.state == "damaged":
        log.error("episode %s is damaged: %s", verdict.path.name, verdict.text)
    update_mark(verdict)
    facts: dict[str, Any] = {
        "damage": marked_damage(data_dir(), verdict.path.name),
        "verified_at": timezone.now(),
    }
    if verdict.state == "sound" and not facts["damage"]:
        facts["seal"] = verdict.seal
    Episode.objects.filter(uuid=UUID(verdict.path.name)).update(**facts)
    return verdict


def compare_with_row(row: Episode, verdict: IntegrityCheck) -> IntegrityCheck:
    """Return `verdict`, or "damaged" in its place if the row contradicts it.

    The row contradicts it if the recording is closed according to the row, but the outcome file on the disk is absent
    or another one.
    """
    if row.status not in CLOSED or verdict.state == "damaged":
        return verdict
    reason = outcome_change(row, None if verdict.state == "open" else verdict.seal)
    if not reason:
        return verdict
    return replace(verdict, state="damaged", damage=(Damage(OUTCOME, reason),), seal=row.seal)


def verify_with_store(uuid: UUID) -> IntegrityCheck:
    """Verify a recording whose videos are here; a changed copy of a file in the store is replaced, and is no damage.

    Raises: RecordingError; StoreError if the store does not give the file.
    """
    folder = journal_folder(uuid)
    verdict = _verify_folder(folder)
    if bring_again(uuid, [damage.file for damage in verdict.damage]):
        verdict = _verify_folder(folder)
    return verdict


def _verify_folder(folder: Path) -> IntegrityCheck:
    """Verify a folder; one that lacks manifest and outcome is damaged, because it belonged to a closed episode."""
    lost = [Damage(name, "is absent") for name in (MANIFEST, OUTCOME) if not (folder / name).exists()]
    if folder.is_dir() and len(lost) == 2 and not (folder / OUTCOME_COPY).exists():
        return IntegrityCheck(folder, "damaged", tuple(lost))
    return verify_episode(folder)


def unverified() -> tuple[int, int]:
    """Return the number of damaged recordings, and of closed ones whose verification is overdue by more than a day."""
    late = timezone.now() - LATE_AFTER
    never = Q(verified_at=None, created_at__lt=late - OLD_AFTER)
    closed = Episode.objects.filter(status__in=CLOSED, away_since=None)
    return (
        closed.exclude(damage=[]).count(),
        closed.filter(never | Q(verified_at__lt=late - AGAIN_AFTER)).count(),
    )


def _due(archived: bool = True) -> QuerySet[Episode]:
    now = timezone.now()
    fresh = Q(verified_at=None) & Q(created_at__gte=now - OLD_AFTER)
    rows = Episode.objects.all() if archived else Episode.objects.filter(archived_at=None)
    return rows.filter(
        Q(verified_at=None) | Q(verified_at__lt=now - AGAIN_AFTER), status__in=CLOSED, away_since=None
    ).exclude(fresh)


def _next(archived: bool) -> Iterator[UUID]:
    rows = _due(archived).order_by(F("verified_at").asc(nulls_first=True), "created_at")
    yield from rows.values_list("uuid", flat=True)[:MOST_EPISODES]
