"""Whether a page's login still holds: its socket outlives the request that opened it."""

from __future__ import annotations

from importlib import import_module
from types import SimpleNamespace
from typing import Any

from django.conf import settings
from django.contrib.auth import get_user

from evaweb.roles import Role, role_of


def role_now(session_key: str) -> Role | None:
    """The role of the session's user as the database has it now.

    None: they have logged out, were switched off, or their password was changed elsewhere. Reads only.
    """
    sessions = import_module(settings.SESSION_ENGINE)
    asks: Any = SimpleNamespace(session=sessions.SessionStore(session_key))
    user = get_user(asks)
    return role_of(user) if user.is_authenticated else None
