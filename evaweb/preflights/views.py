"""Page and fragment of a preflight."""

from __future__ import annotations

from typing import Any
from uuid import UUID

from django.http import HttpRequest, HttpResponse
from django.shortcuts import render
from django.utils import timezone
from django.views.decorators.http import require_GET

from evaweb.blinding.visibility import visibility_for_request
from evaweb.preflights import services
from evaweb.preflights.blinding_rules import visible_preflight
from evaweb.preflights.models import Preflight, PreflightStatus
from evaweb.preflights.report_view import time_since, view_report
from evaweb.preflights.selectors import preflight_get, preflight_newest
from evaweb.trials.selectors import checkpoint_get


@require_GET
def preflight(request: HttpRequest, id: UUID) -> HttpResponse:
    """Show a preflight: its progress, or its result."""
    row = services.refresh_preflight(row=preflight_get(id=id, sight=visibility_for_request(request)))
    fragment = request.headers.get("HX-Request")
    return render(request, f"preflights/{'result' if fragment else 'page'}.html", context(row, request.user))


@require_GET
def newest(request: HttpRequest) -> HttpResponse:
    """Show the newest preflight of the checkpoint in the URL, or that there is none."""
    checkpoint = checkpoint_get(name=request.GET.get("checkpoint", ""), sight=visibility_for_request(request))
    row = preflight_newest(checkpoint=checkpoint)
    if row is None:
        return render(request, "preflights/never.html", {"checkpoint": checkpoint})
    settled = services.refresh_preflight(row=row)
    return render(request, "preflights/result.html", context(settled, request.user))


def context(row: Preflight, user: Any) -> dict[str, Any]:
    """Return the template context of a result."""
    visible = visible_preflight(row, user)
    return {
        "preflight": row,
        "seen": visible,
        "read": view_report(visible.report),
        "running": row.status == PreflightStatus.RUNNING,
        "lacks": services.lacks(row=row),
        "age": time_since(row.asked_at, timezone.now()),
    }
