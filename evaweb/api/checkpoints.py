"""Checkpoints."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from django.http import HttpRequest
from ninja import Query, Router, Schema

from evaweb.api.responses import FAILURES, Page, Paging
from evaweb.blinding.visibility import visibility_for_request
from evaweb.trials import selectors
from evaweb.trials.models import Checkpoint

router = Router(tags=["checkpoints"])


class CheckpointOut(Schema):
    """A trained policy, without the address of its server, which only administrators see."""

    id: int
    name: str
    description: str
    digest: str
    parent: str | None
    recipe: str
    training_set: str | None
    training_run: str | None
    tags: list[str]
    strategy: dict[str, Any] | None
    anchor: bool
    active: bool
    created_at: datetime

    @staticmethod
    def resolve_parent(checkpoint: Checkpoint) -> str | None:
        """Return the name of the parent checkpoint; null if it is hidden."""
        return checkpoint.parent.name if checkpoint.parent else None

    @staticmethod
    def resolve_training_set(checkpoint: Checkpoint) -> str | None:
        """Return the name of the subset of episodes that it was trained on; null if none is stated."""
        return checkpoint.training_set.name if checkpoint.training_set else None

    @staticmethod
    def of(checkpoint: Checkpoint) -> Checkpoint:
        """Return the row unchanged: its attributes have the names of the schema's fields."""
        return checkpoint


@router.get(
    "", response={200: Page[CheckpointOut], **FAILURES}, summary="Checkpoints", url_name="checkpoints"
)
def checkpoints(request: HttpRequest, paging: Query[Paging], inactive: bool = False, tag: str = "") -> Any:
    """Return the checkpoints that operators may choose.

    With `inactive` also those that are switched off, with `tag` only those with this tag. Checkpoints of a blind plan
    are left out unless the caller has unblinded it.
    """
    rows = selectors.checkpoint_list(all_of_them=inactive, tag=tag, sight=visibility_for_request(request))
    return paging.page(rows, CheckpointOut)


@router.get(
    "/{path:name}", response={200: CheckpointOut, **FAILURES}, summary="One checkpoint", url_name="checkpoint"
)
def checkpoint(request: HttpRequest, name: str) -> Any:
    """Return a checkpoint by its name, which may contain slashes, or by its id."""
    return selectors.checkpoint_get(name=name, sight=visibility_for_request(request))
