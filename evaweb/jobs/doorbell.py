"""Tells workers that there is something to do; it may be lost, and nothing else is."""

from __future__ import annotations

import logging

log = logging.getLogger(__name__)

TASK = "evaweb.jobs.work"  # by name: what it does asks for jobs itself


def notify_workers(queue: str) -> bool:
    """Tell the broker; False where it did not take it: a worker finds the row when it next looks."""
    from celery.exceptions import CeleryError  # here, for most programs of a lab never ring
    from kombu.exceptions import KombuError

    from evaweb.celery import app  # which makes the broker's folders

    try:
        app.send_task(TASK, (queue,), queue=queue, retry=False)
    except (KombuError, CeleryError, OSError) as error:
        log.warning("no doorbell for queue %s, a worker finds its jobs within seconds: %r", queue, error)
        return False
    return True
