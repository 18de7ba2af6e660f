"""Waits for a database that is locked or away."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import TypeVar

from django.db import InterfaceError, OperationalError, connection

log = logging.getLogger(__name__)

_Result = TypeVar("_Result")
WAITS_S = (0.2, 0.5, 1.0, 2.0, 5.0, 5.0, 5.0, 5.0)


def retry_while_locked(action: Callable[[], _Result]) -> _Result:
    """The result of `action`, tried again while the database is locked or away; its error after half a minute.

    `action` must be a whole transaction, so that nothing of a failed attempt is left.
    """
    for wait in WAITS_S:
        try:
            return action()
        except (OperationalError, InterfaceError) as error:
            if connection.in_atomic_block:
                raise
            log.warning("the database does not answer, again in %g s: %s", wait, error)
            connection.close()
            time.sleep(wait)
    return action()
