"""Tasks that celery calls; each is one line."""

from __future__ import annotations

from evaweb.celery import app
from evaweb.jobs import services
from evaweb.jobs.doorbell import TASK


@app.task(name=TASK)
def work(queue: str) -> None:
    """The doorbell of a queue."""
    services.run_queue(queue)
