"""Command that writes docs/openapi.json, which a test compares with the interface."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from django.conf import settings
from django.core.management.base import BaseCommand

from evaweb.api.api import openapi_snapshot

PLACE = Path(settings.BASE_DIR) / "docs" / "openapi.json"


class Command(BaseCommand):
    """`manage.py openapi_snapshot`, to be run after a change of the interface."""

    help = f"Write {PLACE.name} anew."

    def handle(self, *args: Any, **options: Any) -> None:
        """Write the file and print its path."""
        PLACE.write_text(openapi_snapshot(), encoding="utf-8")
        self.stdout.write(f"wrote {PLACE}")
