"""Users with open pages: whether their login is still valid, and which checkpoints they may see."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from channels.db import database_sync_to_async
from django.db import Error

from evaweb.accounts.credentials import SESSION, credentials
from evaweb.accounts.roles import Role, role_of
from evaweb.blinding.visibility import Visibility, visibility_for_user

log = logging.getLogger(__name__)


async def current_visibilities(users: Mapping[int, Any]) -> dict[int, Visibility]:
    """Return the visibility by user id; {} if the database does not answer.

    The visibilities known before then remain valid, because nothing new can become hidden: that would need a new
    trial, which the database does not accept either.
    """
    try:
        return await database_sync_to_async(_load_visibilities, thread_sensitive=False)(users)
    except Error as error:
        log.warning("the database does not say what is hidden from whom: %s", error)
        return {}


def _load_visibilities(users: Mapping[int, Any]) -> dict[int, Visibility]:
    return {key: visibility_for_user(user) for key, user in users.items()}


def current_role(session_key: str) -> Role | None:
    """Return the current role of the session's user, read from the database.

    None if they have logged out, were deactivated, or their password was changed elsewhere.
    """
    user = credentials.look_up(SESSION, session_key)
    return None if user is None else role_of(user)
