"""Periodic verification of recordings in small portions, those verified longest ago first."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any
from uuid import UUID

from django.db.models import F, Q, QuerySet
from django.utils import timezone

from evaweb.episodes.folders import data_dir, journal_folder
from evaweb.episodes.manifest import CLOSED
from evaweb.episodes.models import Episode
from evaweb.episodes.services import outcome_change
from evaweb.jobs.kinds import JobContext
from evaweb.jobs.models import Job, JobStatus
from evaweb.jobs.services import enqueue
from runtime.recording.files import RecordingError
from runtime.recording.integrity import Damage, IntegrityCheck
from runtime.recording.outcome_seal import MANIFEST, OUTCOME, OUTCOME_COPY
from runtime.recording.quarantine import marked_damage, update_mark
from runtime.recording.scrub import verify_episode

log = logging.getLogger(__name__)

AGAIN_AFTER = timedelta(days=30)
OLD_AFTER = timedelta(hours=1)  # a new recording is verified at its publication
LATE_AFTER = timedelta(days=1)
MOST_EPISODES, MOST_BYTES = 100, 1 << 30  # limits per job, because other jobs wait meanwhile


def request_scrub() -> Job | None:
    """Queue the verification of due recordings if the workers are idle; return the job, else None."""
    at_work = Job.objects.filter(status__in=(JobStatus.QUEUED, JobStatus.RUNNING))
    if at_work.exists() or not _due().exists():
        return None
    return enqueue(kind="scrub", key="scrub", args={})


def scrub_due(work: JobContext) -> Mapping[str, Any]:
    """Verify the next due recordings and store each result immediately.

    Returns: Number of recordings by result.
    """
    counts = dict.fromkeys(("sound", "damaged", "unsealed", "open"), 0)
    damaged, problems, read = [], [], 0
    for uuid in _next():
        if read >= MOST_BYTES:
            break
        work.report_progress(f"{sum(counts.values())} verified, {len(damaged)} damaged")
        try:
            verdict = record_verification(_verify_folder(journal_folder(uuid)))
        except RecordingError as error:
            problems.append(str(error))
            Episode.objects.filter(uuid=uuid).update(verified_at=timezone.now())
            continue
        counts[verdict.state] += 1
        read += verdict.bytes
        damaged += [{"uuid": str(uuid), "why": verdict.text}] if verdict.state == "damaged" else []
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


def _due() -> QuerySet[Episode]:
    now = timezone.now()
    fresh = Q(verified_at=None) & Q(created_at__gte=now - OLD_AFTER)
    return Episode.objects.filter(
        Q(verified_at=None) | Q(verified_at__lt=now - AGAIN_AFTER), status__in=CLOSED, away_since=None
    ).exclude(fresh)


def _next() -> Iterator[UUID]:
    rows = _due().order_by(F("verified_at").asc(nulls_first=True), "created_at")
    yield from rows.values_list("uuid", flat=True)[:MOST_EPISODES]
