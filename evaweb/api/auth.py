"""Authentication of a caller: logged-in browser, or program with a token."""

from __future__ import annotations

from typing import Any

from django.http import HttpRequest
from ninja.security import HttpBearer, SessionAuth

from evaweb.accounts import login_audit
from evaweb.accounts.client_addresses import client_address
from evaweb.accounts.credentials import SESSION, TOKEN, credentials
from evaweb.api.tokens import UNKNOWN
from evaweb.core.errors import EvaError
from runtime.core.sentences import Pattern, fixed

_UNKNOWN_TOKEN = Pattern(
    "api.auth.unknown_token",
    "the token {unknown}: make one with manage.py api_token USER NAME",
)


NOT_LOGGED_IN = fixed(
    "api.auth.not_logged_in",
    "not logged in: log in, or send Authorization: Bearer TOKEN",
)


class NotLoggedIn(EvaError):
    """Unknown user or token."""

    status = 401


class Bearer(HttpBearer):
    """Authentication by `Authorization: Bearer TOKEN`, with a token of `manage.py api_token`."""

    def authenticate(self, request: HttpRequest, token: str) -> Any:
        """Return the token's user.

        Raises:
            NotLoggedIn: If the token is invalid, even if the request has a valid session.
        """
        user = credentials.look_up(TOKEN, token)
        if user is None:
            login_audit.log_token_refused(client_address(request), UNKNOWN)
            raise NotLoggedIn(_UNKNOWN_TOKEN(unknown=UNKNOWN))
        return user


class Session(SessionAuth):
    """Authentication by the session cookie of a browser; requests with changes need the X-CSRFToken header too."""

    openapi_description = (
        "Named eva_session_ and what the file lab_id of the data folder says, as each lab has its own"
    )

    def _get_key(self, request: HttpRequest) -> str | None:
        if not request.user.is_authenticated:  # so that 401 (log in first) precedes CSRF's 403
            return None
        key = super()._get_key(request)
        if key:
            credentials.remember(SESSION, key, request.user)
        return key
