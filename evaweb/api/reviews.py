"""Quality, verdicts and annotations of episodes, and the next episode to review."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal
from uuid import UUID

from django.http import HttpRequest
from ninja import Field, Router, Schema, Status

from evaweb.accounts.roles import Role, require_role
from evaweb.api.jobs import JobOut
from evaweb.api.responses import FAILURES, Body
from evaweb.blinding.visibility import visibility_for_request
from evaweb.episodes.selectors import episode_get, tag_counts
from evaweb.reviews import selectors, services
from evaweb.reviews.models import Review, Segment, SegmentLabel

router = Router(tags=["reviews"])

_Frame = Annotated[int, Field(ge=0, lt=2**31)]


class FlagOut(Schema):
    """A finding in the frames `first` to `last`, both included; both are -1 if it concerns no frame."""

    kind: str
    severity: Literal["info", "warning", "error"]
    first: int
    last: int
    stream: str
    text: str
    value: float | None
    bound: float | None


class CountOut(Schema):
    """Number of flags of a kind, and of frames with it."""

    flags: int
    frames: int


class QualityOut(Schema):
    """Findings of the quality checks; `unchecked` lists what could not be checked."""

    episode: str
    frames: int
    fps: float
    clean: bool
    worst: Literal["", "info", "warning", "error"]
    flags: list[FlagOut]
    counts: dict[str, CountOut]
    unchecked: list[str]
    figures: dict[str, float | None]


class ReviewOut(Schema):
    """One reviewer's verdict or note on a `frame` or the whole episode; the newest pass or fail counts."""

    uuid: UUID
    verdict: str
    note: str
    frame: int | None
    reviewer: str
    at: datetime

    @staticmethod
    def of(review: Review) -> dict[str, Any]:
        """Return the review with the reviewer's name."""
        plain = ("uuid", "verdict", "note", "frame", "at")
        return {**{name: getattr(review, name) for name in plain}, "reviewer": review.reviewer.get_username()}


class SegmentOut(Schema):
    """A segment of an episode, first and last frame included; `milestone` is the one reached at its last frame."""

    uuid: UUID
    first: int
    last: int
    label: str
    milestone: str
    annotator: str
    at: datetime

    @staticmethod
    def of(segment: Segment) -> dict[str, Any]:
        """Return the segment with the annotator's name."""
        plain = ("uuid", "first", "last", "label", "milestone", "at")
        return {
            **{name: getattr(segment, name) for name in plain},
            "annotator": segment.annotator.get_username(),
        }


class LabelOut(Schema):
    """A label for segments of episodes; `key` starts and ends such a segment in Replay."""

    words: str
    colour: SegmentLabel.Colour
    key: str


class EpisodeReviewsOut(Schema):
    """Reviews (newest first), segments (in order) and quality report of an episode.

    `covered` is the number of other people's reviews and segments that are hidden from the caller, who may still have
    to
    judge the trial.
    """

    verdict: ReviewOut | None
    reviews: list[ReviewOut]
    segments: list[SegmentOut]
    covered: int
    asked: bool
    quality: QualityOut | None


class ReviewIn(Body):
    """A verdict, or a note without one, on the moment `frame` or the whole episode."""

    verdict: Annotated[str, Field(description="pass, fail or note")]
    note: str = ""
    frame: _Frame | None = None


class SegmentIn(Body):
    """A segment of the episode; with `segment` it replaces one of the caller's own."""

    first: _Frame
    last: _Frame
    label: str
    milestone: str = ""
    segment: UUID | None = None


class TagsIn(Body):
    """Tags to add and to remove; they are stored in lower case."""

    add: Annotated[list[str], Field(default_factory=list, max_length=30)]
    remove: Annotated[list[str], Field(default_factory=list, max_length=30)]


class TagsOut(Schema):
    """The episode's tags afterwards, and the changes."""

    tags: list[str]
    added: list[str]
    removed: list[str]


class TagOut(Schema):
    """A tag of the lab and the number of episodes that have it."""

    words: str
    episodes: int


class NextOut(Schema):
    """Next episode without a verdict, null if there is none; `waiting` counts all of them."""

    episode: UUID | None
    waiting: int


@router.get(
    "/reviews/next", response={200: NextOut, **FAILURES}, summary="Next unreviewed", url_name="review-next"
)
def next_unreviewed(request: HttpRequest, after: UUID | None = None) -> Any:
    """Return the next unreviewed episode after the episode `after` in the list, newest first; from the top if none
    follows.
    """
    episode, waiting = selectors.unreviewed_next(after=after)
    return {"episode": episode.uuid if episode else None, "waiting": waiting}


@router.get(
    "/reviews/labels",
    response={200: list[LabelOut], **FAILURES},
    summary="Vocabulary of parts",
    url_name="segment-labels",
)
def labels(request: HttpRequest) -> Any:
    """Return the labels in the lab's order, without retired ones, which segments may still have."""
    return selectors.labels_offered()


@router.get(
    "/episodes/{uuid:uuid}/reviews",
    response={200: EpisodeReviewsOut, **FAILURES},
    summary="What is said of it",
    url_name="episode-reviews",
)
def get_reviews(request: HttpRequest, uuid: UUID) -> Any:
    """Return verdicts, annotations, and the results of the checks."""
    return _said(request, uuid)


@router.post(
    "/episodes/{uuid:uuid}/reviews",
    response={200: EpisodeReviewsOut, **FAILURES},
    summary="Pass, fail or note",
    url_name="episode-review",
)
def review(request: HttpRequest, uuid: UUID, given: ReviewIn) -> Any:
    """Add a verdict or note; earlier ones are never changed. Requires an operator."""
    services.add_review(user=request.auth, episode=episode_get(uuid=uuid), **given.model_dump())
    return _said(request, uuid)


@router.post(
    "/episodes/{uuid:uuid}/segments",
    response={200: EpisodeReviewsOut, **FAILURES},
    summary="Annotate a part",
    url_name="episode-segment",
)
def segment(request: HttpRequest, uuid: UUID, given: SegmentIn) -> Any:
    """Mark a segment, or change one of the caller's own. Requires an operator."""
    services.save_segment(user=request.auth, episode=episode_get(uuid=uuid), **given.model_dump())
    return _said(request, uuid)


@router.post(
    "/episodes/{uuid:uuid}/segments/{uuid:segment}/remove",
    response={200: EpisodeReviewsOut, **FAILURES},
    summary="Take a part away",
    url_name="episode-segment-remove",
)
def remove_segment(request: HttpRequest, uuid: UUID, segment: UUID) -> Any:
    """Remove a segment of the caller's own; administrators may remove any."""
    services.remove_segment(user=request.auth, episode=episode_get(uuid=uuid), segment=segment)
    return _said(request, uuid)


@router.get("/reviews/tags", response={200: list[TagOut], **FAILURES}, summary="Tags", url_name="tags")
def tags(request: HttpRequest) -> Any:
    """Return all tags of episodes in alphabetical order."""
    counts = tag_counts(sight=visibility_for_request(request))
    return [{"words": text, "episodes": episodes} for text, episodes in counts.items()]


@router.post(
    "/episodes/{uuid:uuid}/tags",
    response={200: TagsOut, **FAILURES},
    summary="Tag it",
    url_name="episode-tags",
)
def tags_changed(request: HttpRequest, uuid: UUID, given: TagsIn) -> Any:
    """Add tags to a closed episode and remove others. Requires an operator."""
    changed = services.tags_change(user=request.auth, episode=episode_get(uuid=uuid), **given.model_dump())
    left = visibility_for_request(request).tags_of(episode_get(uuid=uuid))
    return {"tags": left, "added": changed.added, "removed": changed.removed}


@router.get(
    "/episodes/{uuid:uuid}/quality",
    response={200: QualityOut, **FAILURES},
    summary="What the checks found",
    url_name="episode-quality",
)
def quality(request: HttpRequest, uuid: UUID) -> Any:
    """Return the quality report flag by flag, with frames, values and bounds."""
    return selectors.report_get(uuid=episode_get(uuid=uuid).uuid)


@router.post(
    "/episodes/{uuid:uuid}/quality",
    response={202: JobOut, **FAILURES},
    summary="Have it checked",
    url_name="episode-quality-asked",
)
def request_quality(request: HttpRequest, uuid: UUID) -> Any:
    """Queue the quality checks of an episode, even if it was checked before.

    Requires an operator. The job reports the progress.
    """
    require_role(request.auth, Role.OPERATOR)
    job = services.request_quality_check(episode=episode_get(uuid=uuid))
    return Status(202, JobOut.of(job, visibility_for_request(request)))


def _said(request: Any, uuid: UUID) -> dict[str, Any]:
    episode = episode_get(uuid=uuid)
    standing = selectors.get_standing(episode=episode)
    reviews, segments, covered = selectors.opinions_of(
        user=request.auth, episode=episode, sight=visibility_for_request(request)
    )
    return {
        "verdict": ReviewOut.of(standing.review) if standing.review in reviews else None,
        "reviews": [ReviewOut.of(review) for review in reviews],
        "segments": [SegmentOut.of(segment) for segment in segments],
        "covered": covered,
        "asked": standing.asked_at is not None,
        "quality": selectors.report_of(uuid=uuid),
    }
