"""Answer for a name that is locked at its address, on the login pages of the lab and of administration."""

from __future__ import annotations

from math import ceil
from typing import Any

from axes.models import AccessAttempt
from django.conf import settings
from django.db.models import Max
from django.http import HttpRequest, HttpResponse
from django.utils import timezone

from evaweb.callers import address_of
from evaweb.refusals import told
from runtime.core.sentences import Pattern

_LOCKED = Pattern(
    "login.locked",
    "The password was wrong {times} times for this name from this computer. Try again in {minutes} minutes; "
    "an administrator can unlock it earlier. Anyone who is already logged in stays logged in.",
)
_LOCKED_FOR_A_MINUTE = Pattern(
    "login.locked_for_a_minute",
    "The password was wrong {times} times for this name from this computer. Try again in {minutes} minute; "
    "an administrator can unlock it earlier. Anyone who is already logged in stays logged in.",
)


def answer(request: HttpRequest, *given: Any) -> HttpResponse:
    """429 with how long it lasts."""
    seconds = _left(request)
    minutes = ceil(seconds / 60)
    sentence = _LOCKED if minutes > 1 else _LOCKED_FOR_A_MINUTE
    said = sentence(times=settings.AXES_FAILURE_LIMIT, minutes=minutes)
    response = told(request, said, 429, "registration/locked.html")
    response["Retry-After"] = str(seconds)
    return response


def _left(request: HttpRequest) -> int:
    """Until the newest failure no longer counts [s]."""
    username = (getattr(request, "axes_credentials", None) or {}).get("username")
    attempts = AccessAttempt.objects.filter(username=username, ip_address=address_of(request))
    newest = attempts.aggregate(at=Max("attempt_time"))["at"] or timezone.now()
    return max(1, ceil((newest + settings.AXES_COOLOFF_TIME - timezone.now()).total_seconds()))
