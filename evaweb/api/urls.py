"""Addresses of the REST interface; it says itself who may come in, and never redirects to a login page."""

from __future__ import annotations

from django.contrib.auth.decorators import login_not_required
from django.urls import URLPattern

from evaweb.api.api import api

patterns, app_name, namespace = api.urls
for pattern in patterns:
    if isinstance(pattern, URLPattern):
        pattern.callback = login_not_required(pattern.callback)

urls = (patterns, app_name, namespace)
