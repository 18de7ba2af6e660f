"""Named subsets of the episodes."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any

from django.http import HttpRequest, QueryDict
from ninja import Field, Router, Schema, Status

from evaweb.api.responses import FAILURES, Body
from evaweb.blinding.visibility import visibility_for_request
from evaweb.core.errors import EvaError
from evaweb.episodes import listed, subsets
from evaweb.episodes.models import Subset
from evaweb.serving.lists import Listing

router = Router(tags=["episodes"])
Text = Annotated[str, Field(max_length=200)]


class SubsetOut(Schema):
    """Subset: `query` are the filters that found its episodes, `digest` is the SHA-256 of their sorted UUIDs.

    `dataset` is "" until it is published. `checkpoints` were trained on it.
    """

    name: str
    description: str
    query: dict[str, str]
    episodes: int
    digest: str
    created_by: str
    created_at: datetime
    dataset: str
    published_at: datetime | None
    checkpoints: list[str]


class SubsetIn(Body):
    """Name of a new subset, and values of the filters of Replay's list of episodes."""

    name: Annotated[str, Field(max_length=100)]
    description: Annotated[str, Field(max_length=2000)] = ""
    query: dict[str, Text] = Field(default_factory=dict)


def _out(request: HttpRequest, subset: Subset) -> dict[str, Any]:
    visible = visibility_for_request(request).filter_visible(subset.checkpoints.all(), "pk")
    own = ("name", "description", "query", "digest", "created_at", "dataset", "published_at")
    return {
        **{name: getattr(subset, name) for name in own},
        "episodes": subset.episodes.count(),
        "created_by": subset.created_by.username,
        "checkpoints": [checkpoint.name for checkpoint in visible],
    }


@router.get("", response={200: list[SubsetOut], **FAILURES}, summary="Subsets", url_name="subsets")
def subset_list(request: HttpRequest) -> Any:
    """Return the subsets, newest first. Left out are those that name a checkpoint that is hidden from the caller."""
    rows = subsets.subset_list(sight=visibility_for_request(request))
    return [_out(request, row) for row in rows]


@router.post("", response={201: SubsetOut, **FAILURES}, summary="Save a subset", url_name="subsets")
def save_subset(request: HttpRequest, given: SubsetIn) -> Any:
    """Keep the published episodes that the query finds now, under a name. They are published by a job of datasets."""
    visibility = visibility_for_request(request)
    subset = subsets.create_subset(
        user=request.user,
        sight=visibility,
        name=given.name,
        description=given.description,
        query=_query(given.query, listed.filters(visibility)),
    )
    return Status(201, _out(request, subset))


def _query(given: dict[str, str], filters: Any) -> dict[str, str]:
    """Return the value of each filter. Raises: EvaError for an unknown filter or a value that it does not have."""
    names = [entry.name for entry in filters]
    if unknown := [name for name in given if name not in names]:
        raise EvaError(f"query: {unknown[0]!r:.60} is no filter; allowed: {', '.join(names)}")
    query = QueryDict(mutable=True)
    query.update(given)
    listing = Listing(query, (), filters)
    if listing.fault:
        raise EvaError(listing.fault)
    return listing.chosen
