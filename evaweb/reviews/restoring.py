"""Reviews, annotations and reports that the database has lost, made again from the disk."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any
from uuid import UUID

from django.db import transaction

from evaweb.episodes.models import Episode
from evaweb.episodes.reconcile import Kept, restores
from evaweb.errors import EvaError
from evaweb.reviews import selectors, services
from evaweb.reviews.folders import report_file
from evaweb.reviews.kept import KeptReview, Line, kept_lines, segments_of
from evaweb.reviews.models import DECIDES, Review, Segment, Standing
from evaweb.roles import known_person
from runtime.recording.files import RecordingError


@restores
def restore(kept: Kept) -> int:
    """Make the rows of an episode's reviews and segments, and of its report, that are not there; how many."""
    episode = Episode.objects.filter(uuid=kept.uuid).first()
    if episode is None:
        return 0
    _checked(episode)
    lines = kept_lines(kept.uuid)
    if not lines:
        return 0
    with transaction.atomic():
        made = _reviews(episode, [line for line in lines if isinstance(line, KeptReview)])
        return made + _segments(episode, lines)


def _checked(episode: Episode) -> None:
    """The row of a report that lies on the disk."""
    path = report_file(episode.uuid)
    if not path.exists() or Standing.objects.filter(episode=episode).exclude(checked_at=None).exists():
        return
    document = selectors.report_of(uuid=episode.uuid) or {}
    try:
        services.quality_found(
            episode=episode, document=document, at=datetime.fromtimestamp(path.stat().st_mtime, UTC)
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise RecordingError(f"{path} is no report: {error!r}") from error


def _reviews(episode: Episode, lines: Sequence[KeptReview]) -> int:
    last = {line.uuid: line for line in lines}  # of one that was given twice
    there = set(Review.objects.filter(episode=episode).values_list("uuid", flat=True))
    absent = [line for uuid, line in last.items() if uuid not in there]
    _require_free(Review, [line.uuid for line in absent])
    for line in absent:
        Review.objects.create(
            uuid=line.uuid,
            episode=episode,
            verdict=line.verdict,
            note=line.note,
            reviewer=known_person(line.by),
            at=line.at,
        )
    if absent:
        decided = Review.objects.filter(episode=episode, verdict__in=DECIDES).order_by("-at").first()
        services.standing_changed(episode=episode, review=decided)
    return len(absent)


def _require_free(model: type[Review] | type[Segment], uuids: Collection[UUID]) -> None:
    """EvaError where one of them is of another episode."""
    other = model.objects.filter(uuid__in=uuids).first()
    if other is not None:
        raise EvaError(f"its {model.__name__.lower()} {other.uuid} is of episode {other.episode_id}")


def _segments(episode: Episode, lines: Sequence[Line]) -> int:
    """Bring the rows up to what the lines say; a segment is as its newest line."""
    wanted = {line.uuid: line for line in segments_of(lines)}
    for line in wanted.values():
        if line.last < line.first:
            raise EvaError(
                f"its segment {line.uuid} ends at frame {line.last}, before its first {line.first}"
            )
    rows = {row.uuid: row for row in Segment.objects.filter(episode=episode)}
    _require_free(Segment, wanted.keys() - rows.keys())
    changed = 0
    for uuid, line in wanted.items():
        facts: Mapping[str, Any] = {
            "first": line.first,
            "last": line.last,
            "label": line.label,
            "milestone": line.milestone,
            "at": line.at,
        }
        row = rows.get(uuid)
        if row is None:
            Segment.objects.create(uuid=uuid, episode=episode, annotator=known_person(line.by), **facts)
        elif any(getattr(row, name) != value for name, value in facts.items()):
            Segment.objects.filter(pk=uuid).update(**facts)
        else:
            continue
        changed += 1
    gone = [uuid for uuid in rows if uuid not in wanted]
    Segment.objects.filter(pk__in=gone).delete()
    if changed or gone:
        services.standing_changed(episode=episode)
    return changed + len(gone)
