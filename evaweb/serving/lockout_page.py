"""Locking of logins: a user name at one address, and an address from which many names are guessed."""

from __future__ import annotations

from datetime import datetime
from math import ceil
from typing import Any

from axes.models import AccessAttempt
from django.conf import settings
from django.core.exceptions import PermissionDenied
from django.db.models import Max
from django.http import HttpRequest, HttpResponse
from django.utils import timezone

from evaweb.accounts.client_addresses import lockable_of
from evaweb.serving.error_pages import error_response
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


_MANY_NAMES = Pattern(
    "login.many_names",
    "The password was wrong for {names} names from this computer. Try again in {minutes} min. "
    "Anyone who is already logged in stays logged in.",
)
MOST_NAMES = 20  # names with wrong passwords from one address; each may fail AXES_FAILURE_LIMIT times


class ManyNames:
    """Authentication backend that refuses addresses from which passwords of many names are guessed."""

    def authenticate(self, request: HttpRequest | None, **given: Any) -> None:
        """Raise PermissionDenied for an address from which passwords of many names are guessed.

        The axes middleware then responds with `lockout_response`.
        """
        if request is not None and _many_names_until(request) is not None:
            request.axes_locked_out = True  # type: ignore[attr-defined]
            raise PermissionDenied


def lockout_response(request: HttpRequest, *given: Any) -> HttpResponse:
    """Return a response with status 429 that states how long the lock lasts."""
    until = _many_names_until(request)
    seconds = _seconds_to(until or _name_until(request))
    minutes = ceil(seconds / 60)
    if until is not None:
        text = _MANY_NAMES(names=MOST_NAMES, minutes=minutes)
    else:
        sentence = _LOCKED if minutes > 1 else _LOCKED_FOR_A_MINUTE
        text = sentence(times=settings.AXES_FAILURE_LIMIT, minutes=minutes)
    response = error_response(request, text, 429, "registration/locked.html")
    response["Retry-After"] = str(seconds)
    return response


def _name_until(request: HttpRequest) -> datetime:
    """Return when the user name of this request can be used again from the address of this request."""
    username = (getattr(request, "axes_credentials", None) or {}).get("username")
    attempts = AccessAttempt.objects.filter(username=username, ip_address=lockable_of(request))
    newest: datetime = attempts.aggregate(at=Max("attempt_time"))["at"] or timezone.now()
    return newest + settings.AXES_COOLOFF_TIME


def _many_names_until(request: HttpRequest) -> datetime | None:
    """Return until when logins from this address are refused; None if they are not refused now.

    They are refused while passwords of at least MOST_NAMES names were wrong there within AXES_COOLOFF_TIME.
    """
    since = timezone.now() - settings.AXES_COOLOFF_TIME
    attempts = AccessAttempt.objects.filter(ip_address=lockable_of(request), attempt_time__gt=since)
    newest = attempts.values("username").annotate(at=Max("attempt_time")).order_by("-at")
    last = newest.values_list("at", flat=True)[MOST_NAMES - 1 : MOST_NAMES]
    return next((at + settings.AXES_COOLOFF_TIME for at in last), None)


def _seconds_to(moment: datetime) -> int:
    return max(1, ceil((moment - timezone.now()).total_seconds()))
