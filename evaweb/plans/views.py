"""The pictures that are kept: references, and how benches were laid out."""

from __future__ import annotations

from django.http import HttpRequest, HttpResponse
from django.views.decorators.http import require_safe

from evaweb.plans.pictures import kept

_A_YEAR = 365 * 24 * 3600


@require_safe
def picture(request: HttpRequest, name: str) -> HttpResponse:
    """One of them; another picture has another address, so a browser may keep it."""
    answer = HttpResponse(kept(name), content_type="image/jpeg")
    answer["Cache-Control"] = f"private, max-age={_A_YEAR}, immutable"
    return answer
