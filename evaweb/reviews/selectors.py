"""Queries on reviews."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any
from uuid import UUID

from django.db.models import F, Q, QuerySet

from evaweb.blinding.visibility import Visibility
from evaweb.core.errors import Conflict, NotFound
from evaweb.episodes.manifest import CLOSED
from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.reviews.models import Review, Segment, SegmentLabel, Standing
from evaweb.reviews.record import report_file
from runtime.core.sentences import Pattern
from runtime.recording.files import RecordingError, read_json

_HAVE_EPISODE_CHECKED_AGAIN = Pattern(
    "reviews.selectors.have_episode_checked_again",
    "{error}: have the episode checked again",
)
_EPISODE_HAS_NOT_BEEN_CHECKED = Pattern(
    "reviews.selectors.episode_has_not_been_checked",
    "episode {uuid} has not been checked yet: POST to this address has it done",
)

Judges = Callable[[Any, Episode], bool]
_judges: list[Judges] = []


def get_standing(*, episode: Episode) -> Standing:
    """Return the summary of the episode's reviews; if there is none, return an empty one that is not saved."""
    return Standing.objects.filter(episode=episode).select_related("review__reviewer").first() or Standing(
        episode=episode
    )


def report_of(*, uuid: UUID) -> Mapping[str, Any] | None:
    """Return the stored quality report; None before the checks. Raises: Conflict if it is damaged."""
    path = report_file(uuid)
    try:
        return read_json(path) if path.exists() else None
    except RecordingError as error:
        raise Conflict(_HAVE_EPISODE_CHECKED_AGAIN(error=error)) from None


def report_get(*, uuid: UUID) -> Mapping[str, Any]:
    """Return the stored quality report. Raises: NotFound before the checks; Conflict if it is damaged."""
    report = report_of(uuid=uuid)
    if report is None:
        raise NotFound(_EPISODE_HAS_NOT_BEEN_CHECKED(uuid=uuid))
    return report


def opinions_of(*, user: Any, episode: Episode, sight: Visibility) -> tuple[list[Review], list[Segment], int]:
    """Return the reviews and segments that this user may see, and the number of hidden ones.

    Opinions of others are hidden from users who may still have to judge the episode's trial.
    """
    reviews, segments = list(reviews_of(episode=episode)), list(segments_of(episode=episode))
    if not sight.hides_episode(episode) and not any(judges(user, episode) for judges in _judges):
        return reviews, segments, 0
    own = [row for row in reviews if row.reviewer_id == user.pk]
    marked = [row for row in segments if row.annotator_id == user.pk]
    return own, marked, len(reviews) + len(segments) - len(own) - len(marked)


def still_judges(judges: Judges) -> Judges:
    """Register a function that returns whether a user still has to judge an episode blind; return the function.

    Apps of higher layers use it as a decorator.
    """
    _judges.append(judges)
    return judges


def reviews_of(*, episode: Episode) -> QuerySet[Review]:
    """Return all reviews of the episode, newest first."""
    return Review.objects.filter(episode=episode).select_related("reviewer").order_by("-at")


def segments_of(*, episode: Episode) -> QuerySet[Segment]:
    """Return the episode's segments in order."""
    return Segment.objects.filter(episode=episode).select_related("annotator")


def labels_offered() -> QuerySet[SegmentLabel]:
    """Return the active labels for segments."""
    return SegmentLabel.objects.filter(active=True)


def unreviewed_episodes() -> QuerySet[Episode]:
    """Return the closed episodes with frames and without pass or fail, newest first."""
    newest = (F("started_at").desc(nulls_last=True), "-created_at", "uuid")
    closed = Episode.objects.filter(status__in=CLOSED, frames__gt=0)
    return closed.filter(standing__review=None).order_by(*newest)


def unreviewed_next(*, after: UUID | None) -> tuple[Episode | None, int]:
    """Return the next unreviewed episode after `after` in the list, wrapping around, and the number of unreviewed ones.

    Without `after` it is the first. The episode `after` itself is never returned.
    """
    waiting = unreviewed_episodes()
    count = waiting.count()
    current = Episode.objects.filter(uuid=after).first() if after else None
    if current is None:
        return waiting.first(), count
    others_waiting = waiting.exclude(uuid=current.uuid)
    below = others_waiting
    if current.started_at is not None:
        same = Q(started_at=current.started_at, created_at__lt=current.created_at)
        below = others_waiting.filter(Q(started_at__lt=current.started_at) | Q(started_at=None) | same)
    return below.first() or others_waiting.first(), count


def unchecked_episodes() -> QuerySet[Episode]:
    """Return the closed local episodes whose checks were never requested, oldest first."""
    present = Episode.objects.filter(status__in=CLOSED, away_since=None)
    return present.filter(standing__asked_at=None).order_by("created_at")


def outdated_episodes() -> QuerySet[Standing]:
    """Return the standings whose published episode lacks the newest reviews."""
    published = Standing.objects.exclude(episode__published_at=None).exclude(changed_at=None)
    older = (
        Q(attached_at=None)
        | Q(attached_at__lt=F("changed_at"))
        | Q(attached_at__lt=F("episode__published_at"))
    )
    return published.filter(older).exclude(episode__status=EpisodeStatus.MISSING).select_related("episode")
