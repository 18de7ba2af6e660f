"""Search for anything in the lab by a few letters."""

from __future__ import annotations

from typing import Any

from django.http import HttpRequest
from ninja import Router, Schema

from evaweb.api.responses import FAILURES
from evaweb.blinding.visibility import visibility_for_request
from evaweb.find import selectors

router = Router(tags=["find"])


class FoundOut(Schema):
    """One match: its name, a short description, and the address of its page."""

    title: str
    detail: str
    address: str


class GroupOut(Schema):
    """Matches of one kind, the best first, at most eight; `more` is true if there are others."""

    name: str
    items: list[FoundOut]
    more: bool


class AllFoundOut(Schema):
    """All matches, grouped by kind."""

    groups: list[GroupOut]


@router.get("", response={200: AllFoundOut, **FAILURES}, summary="Find anything", url_name="find")
def find(request: HttpRequest, q: str) -> Any:
    """Find stations, trials by number and code, episodes by uuid, plans, checkpoints, scenes, datasets and pages.

    All words of `q` (1 to 200 characters) must match. Hidden things are not found.
    """
    user: Any = request.auth  # type: ignore[attr-defined]
    return {"groups": selectors.find(query=q, user=user, sight=visibility_for_request(request))}
