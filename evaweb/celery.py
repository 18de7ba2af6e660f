"""Celery application of the workers: a doorbell over the file system, or over Redis if configured."""

from __future__ import annotations

import logging
import os
from typing import Any

os.environ.setdefault("DJANGO_SETTINGS_MODULE", "evaweb.settings")

from celery import Celery
from django.conf import settings
from kombu.transport import filesystem

log = logging.getLogger(__name__)


class Transport(filesystem.Transport):
    """File-system transport that polls for a short time only.

    Celery's loop would poll for two seconds at a time, and twice while it ends.
    """

    def drain_events(self, connection: Any, timeout: float | None = None) -> Any:
        """Deliver pending messages; raise socket.timeout if no message arrives within _LONGEST_S."""
        return super().drain_events(connection, timeout=min(timeout or _LONGEST_S, _LONGEST_S))


_LONGEST_S = 0.5
app = Celery("evaweb")


def _filesystem() -> dict[str, object]:
    folder = settings.DATA_DIR / "broker"
    for part in ("queue", "processed", "control"):
        try:
            (folder / part).mkdir(parents=True, exist_ok=True)
        except OSError as error:  # without a doorbell the workers still poll for jobs
            log.warning("%s cannot be made: %s", folder / part, error.strerror)
    return {
        "data_folder_in": str(folder / "queue"),
        "data_folder_out": str(folder / "queue"),
        "processed_folder": str(folder / "processed"),
        "control_folder": str(folder / "control"),
        "store_processed": False,
        "polling_interval": _LONGEST_S,
    }


app.conf.update(
    broker_url=settings.REDIS_URL or "filesystem://localhost/",
    broker_transport=None if settings.REDIS_URL else f"{__name__}:Transport",
    broker_transport_options={"socket_connect_timeout": 2.0} if settings.REDIS_URL else _filesystem(),
    task_ignore_result=True,
    task_acks_late=True,
    worker_prefetch_multiplier=1,
    worker_hijack_root_logger=False,
    worker_enable_remote_control=False,
    broker_connection_retry_on_startup=True,
)
app.autodiscover_tasks(["evaweb.jobs"])
