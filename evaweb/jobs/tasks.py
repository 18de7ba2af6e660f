"""Tasks that celery calls, one line each."""

from __future__ import annotations

from evaweb.celery import app
from evaweb.jobs import services
from evaweb.jobs.doorbell import TASK


@app.task(name=TASK)
def work(queue: str) -> None:
    """Execute the ready jobs of a queue."""
    services.run_queue(queue)
