"""Sight of the users whose pages are open, as the database knows it now."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from channels.db import database_sync_to_async
from django.db import Error

from evaweb.blinding import Visibility, visibility_for_user

log = logging.getLogger(__name__)


async def current_visibilities(users: Mapping[int, Any]) -> dict[int, Visibility]:
    """By the user's id; empty where the database does not answer: it takes no trial either that would hide more."""
    try:
        return await database_sync_to_async(_found, thread_sensitive=False)(users)
    except Error as error:
        log.warning("the database does not say what is hidden from whom: %s", error)
        return {}


def _found(users: Mapping[int, Any]) -> dict[int, Visibility]:
    return {key: visibility_for_user(user) for key, user in users.items()}
