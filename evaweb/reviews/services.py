"""Services for reviews, segments, tags and reports; the line on disk is written before the row."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any
from uuid import UUID

from django.core.exceptions import ValidationError
from django.db import transaction
from django.db.models.functions import Now
from django.utils import timezone

from evaweb.accounts.roles import Role, require_role, role_of
from evaweb.core.errors import (
    Conflict,
    EvaError,
    NotAllowed,
    NotFound,
)
from evaweb.core.printed_names import check_name
from evaweb.episodes.models import LONGEST_TAG, Episode, EpisodeStatus, Tag
from evaweb.jobs.models import Job
from evaweb.jobs.services import enqueue
from evaweb.records.journal import clean_text
from evaweb.reviews.models import DECIDES, Review, Segment, Standing, Verdict
from evaweb.reviews.record import REVIEWS, RemovalLine, ReviewLine, SegmentLine, TagLine, UntagLine
from runtime.core.sentences import Pattern, fixed

_VERDICT_ALLOWED = Pattern("reviews.services.verdict_allowed", "verdict = {verdict!r:.40}; allowed: {values}")
_NOTE_EMPTY_NOTE_NEEDS_WORDS = fixed(
    "reviews.services.note_empty_note_needs_words",
    "note is empty: a note needs words",
)
_LABEL_EMPTY_SAY_WHAT_DONE = fixed(
    "reviews.services.label_empty_say_what_done",
    "label is empty: say what is done in this part",
)
_FIRST_LAST_ALLOWED_FRAMES_0 = Pattern(
    "reviews.services.first_last_allowed_frames_0",
    "first = {first}, last = {last}; allowed: frames 0 to {frames}, the last not before the first",
)
_FRAME_ALLOWED = Pattern("reviews.services.frame_allowed", "frame = {frame}; allowed: 0 to {last}")
_EPISODE_HAS_NO_SEGMENT = Pattern(
    "reviews.services.episode_has_no_segment",
    "episode {uuid} has no segment {uuid_2}",
)
_SEGMENT_MARK_ONE_YOUR_OWN = Pattern(
    "reviews.services.segment_mark_one_your_own",
    "the segment is {annotator}'s: mark one of your own",
)
_EPISODE_STILL_BEING_RECORDED_CHECKED = Pattern(
    "reviews.services.episode_still_being_recorded_checked",
    "episode {uuid} is still being recorded: it is checked when it is closed",
)
_EPISODE_STILL_BEING_RECORDED_REVIEW = Pattern(
    "reviews.services.episode_still_being_recorded_review",
    "episode {uuid} is still being recorded: review it when it is closed",
)

LONGEST_NOTE = 8000  # longest note [characters]
LONGEST_LABEL = 120
LONGEST_MILESTONE = 200
MOST_TAGS = 30  # tags per episode


# --- verdicts ------------------------------------------------------------------------------------------------


@transaction.atomic
def add_review(
    *, user: Any, episode: Episode, verdict: str, note: str = "", frame: int | None = None
) -> Review:
    """Add a pass, fail or note on a closed episode, or on one frame of it; operators only.

    The newest pass or fail counts.
    """
    require_role(user, Role.OPERATOR)
    if verdict not in Verdict.values:
        raise EvaError(_VERDICT_ALLOWED(verdict=verdict, values=", ".join(Verdict.values)))
    note = clean_text("note", note, LONGEST_NOTE)
    if verdict == Verdict.NOTE and not note:
        raise EvaError(_NOTE_EMPTY_NOTE_NEEDS_WORDS)
    _locked_episode(episode)
    if frame is not None and not 0 <= frame < episode.frames:
        raise EvaError(_FRAME_ALLOWED(frame=frame, last=episode.frames - 1))
    values = {"verdict": verdict, "note": note, "frame": frame, "reviewer": user}
    newest = Review.objects.filter(episode=episode).order_by("-at", "-pk").first()
    if newest is not None and all(getattr(newest, name) == value for name, value in values.items()):
        return newest  # repeated request whose answer was lost
    review = Review(episode=episode, at=timezone.now(), **values)
    REVIEWS.append(episode.uuid, ReviewLine.written(review))
    review.save(force_insert=True)
    touch_standing(episode=episode, review=review if verdict in DECIDES else None)
    return review


# --- annotations ---------------------------------------------------------------------------------------------


@transaction.atomic
def save_segment(
    *,
    user: Any,
    episode: Episode,
    first: int,
    last: int,
    label: str,
    milestone: str = "",
    segment: UUID | None = None,
) -> Segment:
    """Mark the frames `first` to `last` (inclusive) as a new segment, or change an existing one.

    With `segment`, the segment of that uuid is changed. The user must be an operator, and may change only segments of
    their own; an administrator may change any segment.
    """
    require_role(user, Role.OPERATOR)
    label, milestone = (
        clean_text("label", label, LONGEST_LABEL),
        clean_text("milestone", milestone, LONGEST_MILESTONE),
    )
    if not label:
        raise EvaError(_LABEL_EMPTY_SAY_WHAT_DONE)
    _locked_episode(episode)
    if not 0 <= first <= last < episode.frames:
        raise EvaError(_FIRST_LAST_ALLOWED_FRAMES_0(first=first, last=last, frames=episode.frames - 1))
    values = {"first": first, "last": last, "label": label, "milestone": milestone}
    existing = Segment.objects.filter(episode=episode, annotator=user, **values).first()
    if existing is not None and segment in (None, existing.pk):
        return existing  # repeated request whose answer was lost
    row = _own(user, episode, segment) if segment else Segment(episode=episode, annotator=user)
    row.first, row.last, row.label, row.milestone, row.at = first, last, label, milestone, timezone.now()
    REVIEWS.append(episode.uuid, SegmentLine.written(row))
    row.save()
    touch_standing(episode=episode)
    return row


@transaction.atomic
def remove_segment(*, user: Any, episode: Episode, segment: UUID) -> None:
    """Remove one's own segment, or any as an administrator; its lines stay on the disk."""
    require_role(user, Role.OPERATOR)
    _locked_episode(episode)
    row = _own(user, episode, segment)
    author = {"by": user.get_username(), "at": timezone.now().isoformat()}
    REVIEWS.append(episode.uuid, RemovalLine.written(row, **author))
    row.delete()
    touch_standing(episode=episode)


def _own(user: Any, episode: Episode, uuid: UUID) -> Segment:
    row = Segment.objects.select_related("annotator").filter(episode=episode, uuid=uuid).first()
    if row is None:
        raise NotFound(_EPISODE_HAS_NO_SEGMENT(uuid=episode.uuid, uuid_2=uuid))
    if row.annotator_id != user.pk and role_of(user) is not Role.ADMIN:
        raise NotAllowed(_SEGMENT_MARK_ONE_YOUR_OWN(annotator=row.annotator))
    return row


# --- tags ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Tagged:
    """Tags that were actually added and removed."""

    added: tuple[str, ...]
    removed: tuple[str, ...]


@transaction.atomic
def tags_change(
    *, user: Any, episode: Episode, add: Sequence[str] = (), remove: Sequence[str] = ()
) -> Tagged:
    """Add and remove tags of a closed episode, whoever added them; operators only."""
    require_role(user, Role.OPERATOR)
    added, unwanted = [tag_of(text) for text in add], {tag_of(text) for text in remove}
    if both := unwanted & set(added):
        raise EvaError(f"add and remove both say {', '.join(sorted(both))}: say it in one of them")
    _locked_episode(episode)
    by_text = {row.words: row for row in Tag.objects.filter(episode=episode)}
    gone = [by_text.pop(text) for text in sorted(unwanted) if text in by_text]
    new = [text for text in dict.fromkeys(added) if text not in by_text]
    if len(by_text) + len(new) > MOST_TAGS:
        raise Conflict(
            f"episode {episode.uuid} would have {len(by_text) + len(new)} tags; allowed: at most {MOST_TAGS}"
        )
    for row in gone:
        author = {"by": user.get_username(), "at": timezone.now().isoformat()}
        REVIEWS.append(episode.uuid, UntagLine.written(row, **author))
        row.delete()
    for text in new:
        row = Tag(episode=episode, words=text, by=user, at=timezone.now())
        REVIEWS.append(episode.uuid, TagLine.written(row))
        row.save(force_insert=True)
    return Tagged(tuple(new), tuple(row.words for row in gone))


def tag_of(given: str) -> str:
    """Return the normalized tag. Raises: EvaError if it is invalid."""
    text = " ".join(clean_text("tag", given, LONGEST_TAG).casefold().split())
    try:
        check_name(text)
    except ValidationError as fault:
        raise EvaError(f"tag: {fault.messages[0]}") from None
    if not text or "," in text or len(text) > LONGEST_TAG:  # casefold can lengthen a text
        raise EvaError(f"tag = {given!r:.80}; allowed: 1 to {LONGEST_TAG} characters without a comma")
    return text


# --- checks --------------------------------------------------------------------------------------------------


@transaction.atomic
def request_quality_check(*, episode: Episode) -> Job:
    """Queue the checks of an episode, also if it was checked before."""
    if episode.status == EpisodeStatus.RECORDING:
        raise Conflict(_EPISODE_STILL_BEING_RECORDED_CHECKED(uuid=episode.uuid))
    Standing.objects.update_or_create(episode=episode, defaults={"asked_at": timezone.now()})
    return enqueue(kind="quality", key=f"quality:{episode.uuid}", args={"uuid": str(episode.uuid)})


@transaction.atomic
def record_quality(*, episode: Episode, document: Mapping[str, Any], at: datetime) -> Standing:
    """Store the summary of the checks; the report itself is on the disk."""
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


def touch_standing(*, episode: Episode, review: Review | None = None) -> None:
    """Record when the episode's reviews changed; `review`, if given, becomes the review that counts.

    The recorded time is that of the database, because it is compared with the times of publications by workers, whose
    clocks may differ.
    """
    facts: dict[str, Any] = {"changed_at": Now()}
    if review is not None:
        facts["review"] = review
    Standing.objects.update_or_create(episode=episode, defaults=facts)


def _locked_episode(episode: Episode) -> None:
    """Lock the episode's row, so that only one process at a time writes the episode's review file.

    Raises:
        Conflict: While the episode is being recorded.
    """
    row = Episode.objects.select_for_update().get(pk=episode.pk)
    if row.status == EpisodeStatus.RECORDING:
        raise Conflict(_EPISODE_STILL_BEING_RECORDED_REVIEW(uuid=episode.uuid))
