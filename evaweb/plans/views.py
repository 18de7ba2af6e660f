"""Pages of stored pictures: references, and benches before runs."""

from __future__ import annotations

from django.http import HttpRequest, HttpResponse
from django.shortcuts import render
from django.urls import reverse
from django.views.decorators.http import require_safe

from evaweb.accounts.roles import Role, role_of
from evaweb.plans import region_matching
from evaweb.plans.bench_checks import references
from evaweb.plans.image_store import load_image
from evaweb.plans.selectors import reference_get


@require_safe
def picture(request: HttpRequest, name: str) -> HttpResponse:
    """Return a stored picture."""
    return HttpResponse(load_image(name), content_type="image/jpeg")


@require_safe
def reference(request: HttpRequest, id: int) -> HttpResponse:
    """Show a reference picture with its regions, which operators can draw, and links to the other cameras."""
    row = reference_get(id=id)
    newest = references(station=row.station, position=row.position)
    context = {
        "reference": row,
        "newest": newest[row.camera],
        "cameras": sorted(newest.items()),
        "editing": {
            "regions": row.regions,
            "most": region_matching.MOST,
            "save": reverse("api:reference-regions", args=[row.pk]),
            "next": reverse("reference", args=[0]),
        },
        "may_draw": row.position is not None
        and newest[row.camera].pk == row.pk
        and role_of(request.user) is not Role.VIEWER,
    }
    return render(request, "plans/reference.html", context)
