"""The lab's terms for failures."""

from __future__ import annotations

from typing import Any

from django.http import HttpRequest
from ninja import Router, Schema

from evaweb.api.responses import FAILURES
from evaweb.trials.models import FailureTerm

router = Router(tags=["scenes"])


class TermOut(Schema):
    """A phase or a cause; `key` chooses it on the Eval page, with Shift."""

    level: FailureTerm.Level
    words: str
    key: str
    order: int
    active: bool


@router.get("", response={200: list[TermOut], **FAILURES}, summary="Why trials fail", url_name="failures")
def failures(request: HttpRequest, inactive: bool = False) -> Any:
    """Return the failure phases, then the causes, in the lab's order; with `inactive` also those that are retired."""
    terms = FailureTerm.objects.all()
    return terms if inactive else terms.filter(active=True)
