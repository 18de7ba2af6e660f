"""Tasks that celery calls; each only calls a service."""

from __future__ import annotations

from evaweb.celery import app
from evaweb.jobs import services, worker
from evaweb.jobs.doorbell import TASK
from evaweb.jobs.kinds import Queue


@app.task(name=TASK)
def work(queue: str) -> None:
    """Execute the ready jobs of a queue."""
    if queue == Queue.COPIES:
        worker.wake_copies()
    else:
        services.run_queue(queue)
