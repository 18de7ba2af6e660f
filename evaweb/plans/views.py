"""The pictures that are kept: references, and how benches were laid out."""

from __future__ import annotations

from django.http import HttpRequest, HttpResponse
from django.views.decorators.http import require_safe

from evaweb.plans.pictures import kept


@require_safe
def picture(request: HttpRequest, name: str) -> HttpResponse:
    """One of them."""
    return HttpResponse(kept(name), content_type="image/jpeg")
