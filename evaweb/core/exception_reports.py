"""Tracebacks of Django without secrets, also with EVA_DEBUG."""

from __future__ import annotations

from django.http import HttpRequest
from django.views.debug import SafeExceptionReporterFilter


class SecretFilter(SafeExceptionReporterFilter):
    """Filter that hides what a view or function declares as sensitive; Django's shows it while DEBUG is on."""

    def is_active(self, request: HttpRequest | None) -> bool:
        """Return True always."""
        return True
