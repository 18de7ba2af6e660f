"""The OpenAPI document as text that is the same each time."""

from __future__ import annotations

import json

from evaweb.api.api import api


def snapshot() -> str:
    """Sorted and indented, so that a difference is one that a person can read."""
    return json.dumps(api.get_openapi_schema(path_prefix="/api/v1/"), indent=1, sort_keys=True) + "\n"
