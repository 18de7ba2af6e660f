"""Retry of transactions while the database is locked or unreachable."""

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
    """Return the result of `action`; retry while the database is locked or unreachable, for about 30 s.

    `action` must be a whole transaction, so that a failed attempt leaves nothing behind. Within an open transaction the
    error is raised at once.
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
