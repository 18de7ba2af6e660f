"""Reproducible text of the OpenAPI document."""

from __future__ import annotations

import json

from django.conf import settings

from evaweb.api.api import api


def openapi_snapshot() -> str:
    """Return the document sorted and indented for readable differences, with a neutral name of the session cookie."""
    said = json.dumps(api.get_openapi_schema(path_prefix="/api/v1/"), indent=1, sort_keys=True) + "\n"
    return said.replace(settings.SESSION_COOKIE_NAME, "eva_session_LAB")
