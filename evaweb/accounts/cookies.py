"""Values of cookies by name: browsers send one per matching path and domain, and only one of them is valid."""

from __future__ import annotations

import time
from collections.abc import Iterable
from importlib import import_module

from django.conf import settings
from django.contrib.sessions.middleware import SessionMiddleware
from django.http import HttpRequest, HttpResponseBase, parse_cookie
from django.utils.http import http_date

from evaweb.accounts.credentials import EXPIRED_ALLOWED, SESSION, credentials

_KEPT_S = 365 * 24 * 3600  # life of the cookie in the browser; the session ends after SESSION_COOKIE_AGE
MOST = 8  # session cookies that are examined; a browser has one or two


def cookie_values(headers: Iterable[str], name: str) -> list[str]:
    """Return the distinct values of all cookies called `name`, in the order of the headers."""
    parts = (part for header in headers for part in header.split(";") if name in part)
    values = (parse_cookie(part).get(name) for part in parts)
    return list(dict.fromkeys(filter(None, values)))


def session_keys(headers: Iterable[str]) -> list[str]:
    """Return the session keys that a browser sent, but at most MOST.

    Of more keys, those with a known session are preferred.
    """
    keys = cookie_values(headers, settings.SESSION_COOKIE_NAME)
    return keys if len(keys) <= MOST else sorted(keys, key=_is_strange)[:MOST]


def _is_strange(key: str) -> bool:
    return not any(credentials.recall(kind, key) for kind in (SESSION, EXPIRED_ALLOWED[SESSION]))


class AnySessionMiddleware(SessionMiddleware):
    """Session middleware for several session cookies: the first that names an existing session counts.

    Django's own uses only the last cookie.
    """

    def process_request(self, request: HttpRequest) -> None:
        keys = session_keys([request.META.get("HTTP_COOKIE", "")])
        if len(keys) > 1:
            exists = import_module(settings.SESSION_ENGINE).SessionStore().exists
            request.COOKIES[settings.SESSION_COOKIE_NAME] = next(filter(exists, keys), keys[-1])
        super().process_request(request)

    def process_response(self, request: HttpRequest, response: HttpResponseBase) -> HttpResponseBase:
        """Delete the cookie only if the session was ended on purpose: an expired session still presses e-stops."""
        answer = super().process_response(request, response)
        cookie = answer.cookies.get(settings.SESSION_COOKIE_NAME)
        if cookie is None:
            return answer
        if cookie.value:
            cookie["max-age"], cookie["expires"] = _KEPT_S, http_date(time.time() + _KEPT_S)
        elif not request.session.modified:  # flush() on logout sets `modified`; mere expiry does not
            del answer.cookies[settings.SESSION_COOKIE_NAME]
        return answer
