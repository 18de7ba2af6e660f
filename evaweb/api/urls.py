"""URL patterns of the REST interface; it checks credentials itself and never redirects to a login page."""

from __future__ import annotations

from django.contrib.auth.decorators import login_not_required
from django.http import HttpRequest, JsonResponse
from django.urls import URLPattern, path
from django.views.decorators.csrf import csrf_exempt

from evaweb.api.api import api
from evaweb.serving import error_pages


@csrf_exempt  # it changes nothing, and 404 is the more accurate answer
def nowhere(request: HttpRequest, rest: str) -> JsonResponse:
    """Answer 404 at an unknown address, in the format of all answers."""
    return JsonResponse({"error": error_pages.unknown_address_sentence(request.path)}, status=404)


patterns, app_name, namespace = api.urls
patterns = [*patterns, path("<path:rest>", nowhere)]
for pattern in patterns:
    if isinstance(pattern, URLPattern):
        pattern.callback = login_not_required(pattern.callback)

urls = (patterns, app_name, namespace)
