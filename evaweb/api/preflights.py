"""Preflights: a checkpoint's server tested without a robot."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any
from uuid import UUID

from django.http import HttpRequest
from ninja import Field, Query, Router, Schema, Status

from evaweb.api.responses import (
    FAILURES,
    Body,
    Page,
    Paging,
)
from evaweb.blinding.visibility import visibility_for_request
from evaweb.preflights import selectors, services
from evaweb.preflights.blinding_rules import visible_preflight
from evaweb.preflights.models import Preflight, PreflightStatus
from evaweb.stations.selectors import station_get
from evaweb.trials.selectors import checkpoint_get

router = Router(tags=["preflights"])


class PreflightOut(Schema):
    """One preflight; `report` is the output of `python -m runtime.preflight --json`, null while it runs.

    `hidden` is the reason why a part of it is hidden from the caller, `reason` why there is no report.
    """

    id: UUID
    checkpoint: str
    station: str
    by: Preflight.By
    status: PreflightStatus
    verdict: str
    asked_by: str
    asked_at: datetime
    ended_at: datetime | None
    reason: str
    hidden: str
    report: dict[str, Any] | None

    @staticmethod
    def of(row: Preflight, user: Any) -> dict[str, Any]:
        """Return the preflight with this user's visibility."""
        visible = visible_preflight(row, user)
        plain = ("by", "status", "verdict", "asked_at", "ended_at")
        return {
            **{name: getattr(row, name) for name in plain},
            "id": row.pk,
            "checkpoint": row.checkpoint.name,
            "station": row.station.name,
            "asked_by": row.user.get_username() if row.user else "",
            "reason": visible.reason,
            "hidden": visible.hidden,
            "report": visible.report,
        }


class PreflightIn(Body):
    """Checkpoint, by name or id, and the station whose deployment is used.

    Without a station, the first one that supports the checkpoint is used.
    """

    checkpoint: str | int
    station: Annotated[str, Field(max_length=63)] = ""


class PreflightFilters(Schema):
    """Filter of preflights by checkpoint (name or id)."""

    checkpoint: str = ""


@router.get("", response={200: Page[PreflightOut], **FAILURES}, summary="Preflights", url_name="preflights")
def preflights(request: HttpRequest, filters: Query[PreflightFilters], paging: Query[Paging]) -> Any:
    """Return the preflights, newest first."""
    visibility = visibility_for_request(request)
    checkpoint = checkpoint_get(name=filters.checkpoint, sight=visibility) if filters.checkpoint else None
    return paging.page(
        selectors.preflight_list(checkpoint=checkpoint, sight=visibility), PreflightOut, request.auth
    )


@router.post(
    "", response={202: PreflightOut, **FAILURES}, summary="Ask for a preflight", url_name="preflight-ask"
)
def start_preflight(request: HttpRequest, given: PreflightIn) -> Any:
    """Start a preflight; read its progress and result at its id."""
    row = services.start_preflight(
        user=request.auth,
        checkpoint=checkpoint_get(name=given.checkpoint, sight=visibility_for_request(request)),
        station=station_get(name=given.station) if given.station else None,
    )
    return Status(202, PreflightOut.of(row, request.auth))


@router.get(
    "/{uuid:id}", response={200: PreflightOut, **FAILURES}, summary="One preflight", url_name="preflight"
)
def preflight(request: HttpRequest, id: UUID) -> Any:
    """Return a preflight: its progress, or its result."""
    row = services.refresh_preflight(
        row=selectors.preflight_get(id=id, sight=visibility_for_request(request))
    )
    return PreflightOut.of(row, request.auth)
