"""Log lines of logins, logouts and refusals.

Names are logged with `ascii()`, so that no control character reaches a terminal. An unknown name is not logged: it may
be a password typed into the wrong field.
"""

from __future__ import annotations

import logging
from typing import Any

from axes.signals import user_locked_out
from django.conf import settings
from django.contrib.auth import get_user_model
from django.contrib.auth.signals import user_logged_in, user_logged_out, user_login_failed
from django.dispatch import receiver
from django.http import HttpRequest

from evaweb.accounts.client_addresses import client_address
from evaweb.core.log_throttle import LogThrottle

log = logging.getLogger(__name__)
_MOST = 1000  # addresses with a rate limit of their own
_EVERY_S = 60.0
_refused = LogThrottle(_EVERY_S, _MOST)
_unverified = LogThrottle(10.0, 16)  # presses can arrive faster than the disk writes


@receiver(user_logged_in)
def _on_login(sender: Any, request: HttpRequest, user: Any, **named: Any) -> None:
    log.info("%a has logged in from %s", user.get_username(), _where(request))


@receiver(user_logged_out)
def _on_logout(sender: Any, request: HttpRequest, user: Any, **named: Any) -> None:
    if user is not None:
        log.info("%a has logged out from %s", user.get_username(), _where(request))


@receiver(user_login_failed)
def _on_login_failed(
    sender: Any, credentials: dict[str, Any], request: HttpRequest | None = None, **named: Any
) -> None:
    log.warning("login of %s failed from %s", _named(credentials.get("username")), _where(request))


@receiver(user_locked_out)
def _on_lockout(
    sender: Any, request: HttpRequest, username: str, ip_address: str | None, **named: Any
) -> None:
    minutes = settings.AXES_COOLOFF_TIME.total_seconds() / 60
    log.warning(
        "login of %s is locked from %s for up to %.0f minutes",
        _named(username),
        ip_address or "nowhere",
        minutes,
    )


def log_token_refused(address: str | None, why: str) -> None:
    """Log a refused token, at most once a minute per address, with the number of suppressed lines."""
    where = address or "nowhere"
    before = _refused.suffix_if_due(where)
    if before is not None:
        log.warning("a token from %s %s%s", where, why, before)


def estop_unverified(station: str, why: Exception) -> None:
    """Log an e-stop that was executed without a verified user, at most once in 10 s per station."""
    before = _unverified.suffix_if_due(station)
    if before is not None:
        log.error("e-stop from unknown user %a obeyed: %s%s", station[:80], why, before)


def _named(username: Any) -> str:
    if get_user_model().objects.filter(username=username or "").exists():
        return ascii(username)
    return f"an unknown name ({len(username or '')} characters)"


def _where(request: HttpRequest | None) -> str:
    return (client_address(request) if request is not None else None) or "nowhere"
