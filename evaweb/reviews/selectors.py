"""Reads of what is said of episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any
from uuid import UUID

from django.db.models import F, Q, QuerySet

from evaweb.blinding import Visibility
from evaweb.episodes.manifest import CLOSED
from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.errors import Conflict, NotFound
from evaweb.reviews.folders import report_file
from evaweb.reviews.models import Review, Segment, SegmentLabel, Standing
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
    """Standing of the episode; one of which nothing is known stands at the beginning."""
    return Standing.objects.filter(episode=episode).select_related("review__reviewer").first() or Standing(
        episode=episode
    )


def report_of(*, uuid: UUID) -> Mapping[str, Any] | None:
    """Report of the checks, as written down; None where they were not done. Conflict if it is damaged."""
    path = report_file(uuid)
    try:
        return read_json(path) if path.exists() else None
    except RecordingError as error:
        raise Conflict(_HAVE_EPISODE_CHECKED_AGAIN(error=error)) from None


def report_get(*, uuid: UUID) -> Mapping[str, Any]:
    """The same; NotFound where the checks were not done."""
    found = report_of(uuid=uuid)
    if found is None:
        raise NotFound(_EPISODE_HAS_NOT_BEEN_CHECKED(uuid=uuid))
    return found


def opinions_of(*, user: Any, episode: Episode, sight: Visibility) -> tuple[list[Review], list[Segment], int]:
    """What people said of it and its annotated parts, and how much of both is kept from this user.

    What others say is kept from whoever may still have to judge its trial.
    """
    reviews, segments = list(reviews_of(episode=episode)), list(segments_of(episode=episode))
    if not sight.hides_episode(episode) and not any(judges(user, episode) for judges in _judges):
        return reviews, segments, 0
    own = [row for row in reviews if row.reviewer_id == user.pk]
    marked = [row for row in segments if row.annotator_id == user.pk]
    return own, marked, len(reviews) + len(segments) - len(own) - len(marked)


def still_judges(judges: Judges) -> Judges:
    """Declare from above who has to judge the trial of an episode without knowing what others say of it."""
    _judges.append(judges)
    return judges


def reviews_of(*, episode: Episode) -> QuerySet[Review]:
    """All that people said of it, the newest first."""
    return Review.objects.filter(episode=episode).select_related("reviewer").order_by("-at")


def segments_of(*, episode: Episode) -> QuerySet[Segment]:
    """Its annotated parts, in order."""
    return Segment.objects.filter(episode=episode).select_related("annotator")


def labels_offered() -> QuerySet[SegmentLabel]:
    """The lab's vocabulary of parts, without what is retired."""
    return SegmentLabel.objects.filter(active=True)


def unreviewed_episodes() -> QuerySet[Episode]:
    """Closed episodes with pictures or rows to look at and without a pass or fail, the newest first."""
    newest = (F("started_at").desc(nulls_last=True), "-created_at", "uuid")
    closed = Episode.objects.filter(status__in=CLOSED, frames__gt=0)
    return closed.filter(standing__review=None).order_by(*newest)


def unreviewed_next(*, after: UUID | None) -> tuple[Episode | None, int]:
    """The next one after that episode in the list, from its top where there is none below; and how many there are.

    Without `after` the first. The episode itself is never the next.
    """
    waiting = unreviewed_episodes()
    count = waiting.count()
    here = Episode.objects.filter(uuid=after).first() if after else None
    if here is None:
        return waiting.first(), count
    others = waiting.exclude(uuid=here.uuid)
    below = others
    if here.started_at is not None:
        same = Q(started_at=here.started_at, created_at__lt=here.created_at)
        below = others.filter(Q(started_at__lt=here.started_at) | Q(started_at=None) | same)
    return below.first() or others.first(), count


def unchecked_episodes() -> QuerySet[Episode]:
    """Closed episodes that are here and of which no checks were ever asked for, the oldest first."""
    here = Episode.objects.filter(status__in=CLOSED, away_since=None)
    return here.filter(standing__asked_at=None).order_by("created_at")


def outdated_episodes() -> QuerySet[Standing]:
    """Those whose published episode has not the newest of what is said of it."""
    published = Standing.objects.exclude(episode__published_at=None).exclude(changed_at=None)
    older = (
        Q(attached_at=None)
        | Q(attached_at__lt=F("changed_at"))
        | Q(attached_at__lt=F("episode__published_at"))
    )
    return published.filter(older).exclude(episode__status=EpisodeStatus.MISSING).select_related("episode")
