"""Changes to verdicts, annotations and reports: a line on the disk first, then the row."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Any
from uuid import UUID

from django.db import transaction
from django.db.models.functions import Now
from django.utils import timezone

from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.errors import Conflict, EvaError, NotAllowed, NotFound
from evaweb.jobs.models import Job
from evaweb.jobs.services import enqueue
from evaweb.journal import text
from evaweb.reviews.models import DECIDES, Review, Segment, Standing, Verdict
from evaweb.reviews.record import REVIEWS, RemovalLine, ReviewLine, SegmentLine
from evaweb.roles import Role, require, role_of

LONGEST_NOTE = 8000  # characters
LONGEST_LABEL = 120
LONGEST_MILESTONE = 200


# --- verdicts ------------------------------------------------------------------------------------------------


@transaction.atomic
def review_add(*, user: Any, episode: Episode, verdict: str, note: str = "") -> Review:
    """Say pass, fail or a note of an episode that is closed; operators. The newest pass or fail counts."""
    require(user, Role.OPERATOR)
    if verdict not in Verdict.values:
        raise EvaError(f"verdict = {verdict!r:.40}; allowed: {', '.join(Verdict.values)}")
    note = text("note", note, LONGEST_NOTE)
    if verdict == Verdict.NOTE and not note:
        raise EvaError("note is empty: a note needs words")
    _held(episode)
    newest = Review.objects.filter(episode=episode).order_by("-at", "-pk").first()
    if newest is not None and (newest.reviewer, newest.verdict, newest.note) == (user, verdict, note):
        return newest  # said once more, because the answer was lost
    review = Review(episode=episode, verdict=verdict, note=note, reviewer=user, at=timezone.now())
    REVIEWS.append(episode.uuid, ReviewLine.written(review))
    review.save(force_insert=True)
    standing_changed(episode=episode, review=review if verdict in DECIDES else None)
    return review


# --- annotations ---------------------------------------------------------------------------------------------


@transaction.atomic
def segment_put(
    *,
    user: Any,
    episode: Episode,
    first: int,
    last: int,
    label: str,
    milestone: str = "",
    segment: UUID | None = None,
) -> Segment:
    """Mark the frames `first` to `last`, both included; with `segment`, change that one of one's own. Operators."""
    require(user, Role.OPERATOR)
    label, milestone = text("label", label, LONGEST_LABEL), text("milestone", milestone, LONGEST_MILESTONE)
    if not label:
        raise EvaError("label is empty: say what is done in this part")
    _held(episode)
    if not 0 <= first <= last < episode.frames:
        raise EvaError(
            f"first = {first}, last = {last}; allowed: frames 0 to {episode.frames - 1}, the last not before the first"
        )
    said = {"first": first, "last": last, "label": label, "milestone": milestone}
    there = Segment.objects.filter(episode=episode, annotator=user, **said).first()
    if there is not None and segment in (None, there.pk):
        return there  # marked once more, because the answer was lost
    row = _own(user, episode, segment) if segment else Segment(episode=episode, annotator=user)
    row.first, row.last, row.label, row.milestone, row.at = first, last, label, milestone, timezone.now()
    REVIEWS.append(episode.uuid, SegmentLine.written(row))
    row.save()
    standing_changed(episode=episode)
    return row


@transaction.atomic
def segment_remove(*, user: Any, episode: Episode, segment: UUID) -> None:
    """Take a part of one's own away again; an administrator any. Its lines stay on the disk."""
    require(user, Role.OPERATOR)
    _held(episode)
    row = _own(user, episode, segment)
    said = {"by": user.get_username(), "at": timezone.now().isoformat()}
    REVIEWS.append(episode.uuid, RemovalLine.written(row, **said))
    row.delete()
    standing_changed(episode=episode)


def _own(user: Any, episode: Episode, uuid: UUID) -> Segment:
    row = Segment.objects.select_related("annotator").filter(episode=episode, uuid=uuid).first()
    if row is None:
        raise NotFound(f"episode {episode.uuid} has no segment {uuid}")
    if row.annotator_id != user.pk and role_of(user) is not Role.ADMIN:
        raise NotAllowed(f"the segment is {row.annotator}'s: mark one of your own")
    return row


# --- checks --------------------------------------------------------------------------------------------------


@transaction.atomic
def quality_asked(*, episode: Episode) -> Job:
    """Have the worker look the episode through, again where it has."""
    if episode.status == EpisodeStatus.RECORDING:
        raise Conflict(f"episode {episode.uuid} is still being recorded: it is checked when it is closed")
    Standing.objects.update_or_create(episode=episode, defaults={"asked_at": timezone.now()})
    return enqueue(kind="quality", key=f"quality:{episode.uuid}", args={"uuid": str(episode.uuid)})


@transaction.atomic
def quality_found(*, episode: Episode, document: Mapping[str, Any], at: datetime) -> Standing:
    """Keep what the checks found; the report itself lies on the disk."""
    counts = document.get("counts", {})
    facts = {
        "asked_at": at,
        "checked_at": at,
        "clean": bool(document["clean"]),
        "worst": str(document["worst"]),
        "flags": sum(int(count["flags"]) for count in counts.values()),
    }
    return Standing.objects.update_or_create(episode=episode, defaults=facts)[0]


# --- what both have in common --------------------------------------------------------------------------------


def standing_changed(*, episode: Episode, review: Review | None = None) -> None:
    """Something was said of it; `review` counts from now on, None leaves the one that does.

    By the database's time, as publications are: they are compared, and workers have clocks of their own.
    """
    facts: dict[str, Any] = {"changed_at": Now()}
    if review is not None:
        facts["review"] = review
    Standing.objects.update_or_create(episode=episode, defaults=facts)


def _held(episode: Episode) -> None:
    """Make this the one writer of the episode's file; Conflict while it is being recorded."""
    row = Episode.objects.select_for_update().get(pk=episode.pk)
    if row.status == EpisodeStatus.RECORDING:
        raise Conflict(f"episode {episode.uuid} is still being recorded: review it when it is closed")
