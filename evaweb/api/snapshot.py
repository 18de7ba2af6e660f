"""The OpenAPI document as text that is the same each time."""

from __future__ import annotations

import json

from django.conf import settings

from evaweb.api.api import api


def openapi_snapshot() -> str:
    """Sorted and indented, so that a difference is one that a person can read; of no lab, whose cookie has its name."""
    said = json.dumps(api.get_openapi_schema(path_prefix="/api/v1/"), indent=1, sort_keys=True) + "\n"
    return said.replace(settings.SESSION_COOKIE_NAME, "eva_session_LAB")
