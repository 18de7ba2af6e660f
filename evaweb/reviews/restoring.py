"""Restoring of lost reviews, annotations and reports from the disk."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from uuid import UUID

from django.db import transaction

from evaweb.episodes.models import Episode, Tag
from evaweb.episodes.reconcile import RestorableRun, register_restorer
from evaweb.records.journal import missing_rows
from evaweb.reviews import selectors, services
from evaweb.reviews.models import DECIDES, Review, Segment, Standing
from evaweb.reviews.record import REVIEWS, AnyReview, ReviewLine, report_file, segments_of, tags_of
from runtime.recording.files import RecordingError


@register_restorer
def restore(kept: RestorableRun) -> int:
    """Restore the missing rows of an episode's reviews, segments, tags and report; return their number."""
    episode = Episode.objects.filter(uuid=kept.uuid).first()
    if episode is None:
        return 0
    _checked(episode)
    left_out: list[str] = []
    lines = REVIEWS.read(kept.uuid, left_out.append)
    for problem in left_out:
        kept.report_problem(problem)
    if not lines:
        return 0
    with transaction.atomic():
        created = _reviews(episode, [line for line in lines if isinstance(line, ReviewLine)])
        created += _segments(episode, lines, whole=not left_out)
        return created + _tags(episode, lines, whole=not left_out)


def _checked(episode: Episode) -> None:
    """Restore the row of a report on disk."""
    path = report_file(episode.uuid)
    if not path.exists() or Standing.objects.filter(episode=episode).exclude(checked_at=None).exists():
        return
    document = selectors.report_of(uuid=episode.uuid) or {}
    try:
        services.record_quality(
            episode=episode, document=document, at=datetime.fromtimestamp(path.stat().st_mtime, UTC)
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise RecordingError(f"{path} is no report: {error!r}") from error


def _reviews(episode: Episode, lines: Sequence[ReviewLine]) -> int:
    lost = missing_rows(Review, lines, episode=episode)
    for line in lost:
        Review.objects.create(episode=episode, **line.to_row_values())
    if lost:
        decided = Review.objects.filter(episode=episode, verdict__in=DECIDES).order_by("-at").first()
        services.touch_standing(episode=episode, review=decided)
    return len(lost)


def _segments(episode: Episode, lines: Sequence[AnyReview], *, whole: bool) -> int:
    """Update the episode's rows of segments from its lines; return the number of changed rows.

    Each row gets the values of its segment's newest line, and rows of segments without a line are deleted. If lines
    were skipped (`whole` is False), rows are only added, because the missing lines may have changed other rows.
    """
    by_uuid = {line.uuid: line for line in segments_of(lines)}
    changed = 0
    for line in missing_rows(Segment, list(by_uuid.values()), episode=episode):
        Segment.objects.create(episode=episode, **line.to_row_values())
        changed += 1
    gone: list[UUID] = []
    if whole:
        rows = {row.uuid: row for row in Segment.objects.filter(episode=episode)}
        for uuid, line in by_uuid.items():
            facts = line.model_dump(exclude={"kind", "uuid", "by"})
            if any(getattr(rows[uuid], name) != value for name, value in facts.items()):
                Segment.objects.filter(pk=uuid).update(**facts)
                changed += 1
        gone = [uuid for uuid in rows if uuid not in by_uuid]
        Segment.objects.filter(pk__in=gone).delete()
    if changed or gone:
        services.touch_standing(episode=episode)
    return changed + len(gone)


def _tags(episode: Episode, lines: Sequence[AnyReview], *, whole: bool) -> int:
    """Update the episode's rows of tags from its lines; return the number of changed rows.

    Rows of tags without a line are deleted. If lines were skipped (`whole` is False), rows are only added.
    """
    tags = tags_of(lines)
    gone = Tag.objects.filter(episode=episode).exclude(pk__in=[line.uuid for line in tags])
    changed = gone.delete()[0] if whole else 0
    texts = set(Tag.objects.filter(episode=episode).values_list("words", flat=True))
    for line in missing_rows(Tag, [line for line in tags if line.words not in texts], episode=episode):
        Tag.objects.create(episode=episode, **line.to_row_values())
        changed += 1
    return changed
