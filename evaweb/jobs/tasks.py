"""Tasks that celery calls; each only calls a service."""

from __future__ import annotations

from evaweb.celery import app
from evaweb.jobs import services
from evaweb.jobs.doorbell import TASK


@app.task(name=TASK)
def work(queue: str) -> None:
    """Execute the ready jobs of a queue."""
    services.run_queue(queue)
