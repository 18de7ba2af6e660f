"""Reads of preflights."""

from __future__ import annotations

from uuid import UUID

from django.db.models import QuerySet

from evaweb.blinding import FULL_VISIBILITY, Visibility
from evaweb.errors import NotFound
from evaweb.preflights.models import Preflight
from evaweb.trials.models import Checkpoint
from runtime.core.sentences import Pattern

_PREFLIGHT_DOES_NOT_EXIST = Pattern(
    "preflights.selectors.preflight_does_not_exist",
    "preflight {identity} does not exist",
)


def preflight_list(
    *, checkpoint: Checkpoint | None = None, sight: Visibility = FULL_VISIBILITY
) -> QuerySet[Preflight]:
    """The newest first, of one checkpoint or of all; none of hidden ones, whose names they have."""
    rows: QuerySet[Preflight] = sight.filter_visible(
        Preflight.objects.select_related("checkpoint", "station", "user")
    )
    return rows if checkpoint is None else rows.filter(checkpoint=checkpoint)


def preflight_get(*, id: UUID | str, sight: Visibility = FULL_VISIBILITY) -> Preflight:
    """That one; NotFound."""
    found = preflight_list(sight=sight).filter(pk=id).first()
    if found is None:
        raise NotFound(_PREFLIGHT_DOES_NOT_EXIST(identity=id))
    return found


def preflight_newest(*, checkpoint: Checkpoint) -> Preflight | None:
    """Newest preflight of a checkpoint, None where it was never asked."""
    return preflight_list(checkpoint=checkpoint).first()
