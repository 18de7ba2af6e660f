"""Check of a page's login: a socket outlives the request that opened it."""

from __future__ import annotations

from evaweb.accounts.credentials import SESSION, credentials
from evaweb.accounts.roles import Role, role_of


def current_role(session_key: str) -> Role | None:
    """Return the current role of the session's user, read from the database.

    None if they have logged out, were deactivated, or their password was changed elsewhere.
    """
    user = credentials.look_up(SESSION, session_key)
    return None if user is None else role_of(user)
