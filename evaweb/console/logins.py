"""Check that a page's login still holds: its socket outlives the request that opened it."""

from __future__ import annotations

from evaweb.credentials import SESSION, credentials
from evaweb.roles import Role, role_of


def current_role(session_key: str) -> Role | None:
    """The role of the session's user as the database has it now.

    None: they have logged out, were switched off, or their password was changed elsewhere. Reads only.
    """
    user = credentials.look_up(SESSION, session_key)
    return None if user is None else role_of(user)
