"""Queries on preflights."""

from __future__ import annotations

from uuid import UUID

from django.db.models import QuerySet

from evaweb.blinding.visibility import FULL_VISIBILITY, Visibility
from evaweb.core.errors import NotFound
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
    """Return the preflights of one checkpoint, or of all, newest first.

    Those of checkpoints hidden from the user are left out.
    """
    rows: QuerySet[Preflight] = sight.filter_visible(
        Preflight.objects.select_related("checkpoint", "station", "user")
    )
    return rows if checkpoint is None else rows.filter(checkpoint=checkpoint)


def preflight_get(*, id: UUID | str, sight: Visibility = FULL_VISIBILITY) -> Preflight:
    """Return the preflight with that id. Raises: NotFound."""
    row = preflight_list(sight=sight).filter(pk=id).first()
    if row is None:
        raise NotFound(_PREFLIGHT_DOES_NOT_EXIST(identity=id))
    return row


def preflight_newest(*, checkpoint: Checkpoint) -> Preflight | None:
    """Return the newest preflight of a checkpoint, None if there is none."""
    return preflight_list(checkpoint=checkpoint).first()
