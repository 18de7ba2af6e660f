"""Notification of workers that a job is waiting; losing one is harmless, because workers also poll."""

from __future__ import annotations

import logging

log = logging.getLogger(__name__)

TASK = "evaweb.jobs.work"  # sent by name: the task's module enqueues jobs itself, an import would be circular


def notify_workers(queue: str) -> bool:
    """Notify the workers of a queue of a new job, through the broker.

    Returns:
        False if the broker did not accept the notification; a worker then finds the job's row at its next poll.
    """
    from celery.exceptions import CeleryError  # imported late: most programs never notify
    from kombu.exceptions import KombuError

    from evaweb.celery import app  # importing it creates the broker's folders

    try:
        app.send_task(TASK, (queue,), queue=queue, retry=False)
    except (KombuError, CeleryError, OSError) as error:
        log.warning("no doorbell for queue %s, a worker finds its jobs within seconds: %r", queue, error)
        return False
    return True
