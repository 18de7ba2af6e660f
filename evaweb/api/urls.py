"""Addresses of the REST interface; it judges credentials itself, and never redirects to a login page."""

from __future__ import annotations

from django.contrib.auth.decorators import login_not_required
from django.http import HttpRequest, JsonResponse
from django.urls import URLPattern, path
from django.views.decorators.csrf import csrf_exempt

from evaweb import refusals
from evaweb.api.api import api


@csrf_exempt  # it changes nothing, and its answer is the truer one
def nowhere(request: HttpRequest, rest: str) -> JsonResponse:
    """Answer at an unknown address of the interface, in the form of all its answers."""
    return JsonResponse({"error": refusals.unknown_address_sentence(request.path)}, status=404)


patterns, app_name, namespace = api.urls
patterns = [*patterns, path("<path:rest>", nowhere)]
for pattern in patterns:
    if isinstance(pattern, URLPattern):
        pattern.callback = login_not_required(pattern.callback)

urls = (patterns, app_name, namespace)
