"""Registry of running workers, and jobs that none of them can execute.

A worker serves the queues that it was started with. Most kinds of jobs need the lab's data folder; a worker with
another folder executes only the other kinds. With SQLite there is only one machine, and its data folder is the lab's.
With another database the web declares its own data folder as the lab's: a worker on another machine with its own, empty
folder would report the lab's recordings as missing.
"""

from __future__ import annotations

import logging
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from uuid import UUID

from django.conf import settings
from django.db import connection, transaction
from django.db.models import Q, QuerySet
from django.db.models.functions import Now

from evaweb.core.errors import EvaError
from evaweb.jobs.kinds import Queue, UnknownKind, declared
from evaweb.jobs.models import Job, JobStatus, LabFolder, WorkerProcess
from runtime.core.sentences import Pattern, fixed

log = logging.getLogger(__name__)

_FORGOTTEN_S = 24 * 3600.0
NOBODY = fixed("jobs.workers.nobody", "No worker is running: start one with manage.py worker.")
NO_QUEUE = Pattern(
    "jobs.workers.no_queue",
    "No running worker takes the queue {queue}: start one with manage.py worker --queues {queue}.",
)
NO_FOLDER = Pattern(
    "jobs.workers.no_folder",
    "No running worker that takes the queue {queue} has the lab's data folder, which this job works on: start one "
    "where that is.",
)
_ANOTHER_FOLDER = Pattern(
    "jobs.workers.another_folder",
    "this database is that of the data folder {theirs} of {host}, whose worker runs; this one is {ours}: end that lab "
    "first, or set DATABASE_URL to a database of this lab's own",
)


# --- the lab's data folder -----------------------------------------------------------------------------------


def has_lab_folder() -> bool:
    """Return True if the data folder of this process is the lab's."""
    if connection.vendor == "sqlite":
        return True
    return LabFolder.objects.filter(pk=1, lab_id=settings.EVA_LAB_ID).exists()


@transaction.atomic
def lab_folder_named() -> None:
    """Declare the data folder of this process, which serves the web, as the lab's.

    Raises: EvaError while a worker with another lab's folder is running.
    """
    if connection.vendor == "sqlite":
        return
    host = socket.gethostname()
    fields = {"lab_id": settings.EVA_LAB_ID, "host": host, "path": str(settings.DATA_DIR)}
    row, created = LabFolder.objects.select_for_update().get_or_create(pk=1, defaults=fields)
    if created or row.lab_id == settings.EVA_LAB_ID:
        return
    if _running().filter(folder=True).exists():
        raise EvaError(_ANOTHER_FOLDER(theirs=row.path, host=row.host, ours=fields["path"]))
    log.warning(
        "the data folder of the lab was %s of %s; it is %s of %s", row.path, row.host, fields["path"], host
    )
    LabFolder.objects.filter(pk=1).update(**fields)


# --- workers -------------------------------------------------------------------------------------------------


def record_heartbeat(*, owner: UUID, queues: Sequence[str]) -> bool:
    """Record a heartbeat of the worker, which also registers a new worker; always return True."""
    fields = {
        "host": socket.gethostname(),
        "queues": list(queues),
        "folder": has_lab_folder(),
        "seen_at": Now(),
    }
    WorkerProcess.objects.update_or_create(pk=owner, defaults=fields)
    return True


def worker_ended(*, owner: UUID) -> None:
    """Remove the worker from the registry, and all workers that have sent no heartbeat for a day."""
    gone = Q(pk=owner) | Q(seen_at__lt=Now() - timedelta(seconds=_FORGOTTEN_S))
    WorkerProcess.objects.filter(gone).delete()


def _running() -> QuerySet[WorkerProcess]:
    return WorkerProcess.objects.filter(seen_at__gte=Now() - timedelta(seconds=settings.EVA_JOB_STALE_S))


# --- jobs that nobody takes ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Served:
    """Queues that the running workers serve."""

    queues: frozenset[str]
    with_folder: frozenset[str]  # queues of workers with the lab's data folder

    def lacks(self, job: Job) -> str:
        """Return why no running worker can execute a queued job, as a message; "" if one can or it is not queued."""
        return self.lacks_for(job.kind, job.queue) if job.status == JobStatus.QUEUED else ""

    def lacks_for(self, kind: str, queue: str) -> str:
        """Return why no running worker can execute jobs of `kind` in `queue`; "" if one can."""
        if not self.queues:
            return NOBODY
        if queue not in self.queues:
            return NO_QUEUE(queue=queue)
        try:
            folder = declared(kind).folder
        except UnknownKind:  # declared by another release, whose worker may execute it
            return ""
        return NO_FOLDER(queue=queue) if folder and queue not in self.with_folder else ""


def served() -> Served:
    """Return the queues of workers that sent a heartbeat within EVA_JOB_STALE_S."""
    rows = list(_running().values_list("queues", "folder"))
    return Served(
        frozenset(queue for queues, _ in rows for queue in queues),
        frozenset(queue for queues, folder in rows if folder for queue in queues),
    )


def waiting_for(job: Job) -> str:
    """Return why no running worker can execute the job, "" if one can."""
    return served().lacks(job) if job.status == JobStatus.QUEUED else ""


def queue_names(given: str) -> list[str]:
    """Return the distinct queues that the value of option --queues names, separated by commas.

    Raises:
        EvaError: If a name is not a queue, or if there is none; the message lists the allowed queues.
    """
    requested = {name.strip() for name in given.split(",") if name.strip()}
    if not requested or not requested <= set(Queue):
        raise EvaError(f"--queues {given!r:.120}: allowed: {', '.join(Queue)}, with commas between them")
    return [queue.value for queue in Queue if queue in requested]
