"""Tells workers that there is something to do; it may be lost, and nothing else is."""

from __future__ import annotations

import logging

from celery.exceptions import CeleryError
from kombu.exceptions import KombuError

log = logging.getLogger(__name__)


def ring(queue: str) -> bool:
    """Whether the broker took it; where it did not, a worker finds the row when it next looks."""
    try:
        from evaweb.jobs.tasks import work  # here, for services and tasks know each other

        work.apply_async((queue,), queue=queue, retry=False)
    except (KombuError, CeleryError, OSError) as error:
        log.warning("no doorbell for queue %s, a worker finds its jobs within seconds: %r", queue, error)
        return False
    return True
