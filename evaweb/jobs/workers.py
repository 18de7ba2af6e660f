"""Workers that run, and which jobs none of them can take.

A worker takes the queues that it was started with. Most kinds work on the lab's data folder; one whose folder is
another takes the rest alone. On SQLite there is one machine, whose folder that is. Elsewhere the web says which it is:
a worker of another machine that believed its own, empty one would read the lab's recordings as missing.
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

from evaweb.errors import EvaError
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
    """True if the data folder of this process is the lab's."""
    if connection.vendor == "sqlite":
        return True
    return LabFolder.objects.filter(pk=1, lab_id=settings.EVA_LAB_ID).exists()


@transaction.atomic
def lab_folder_named() -> None:
    """Say that the data folder of this process, which serves the web, is the lab's; EvaError while another's runs."""
    if connection.vendor == "sqlite":
        return
    host = socket.gethostname()
    ours = {"lab_id": settings.EVA_LAB_ID, "host": host, "path": str(settings.DATA_DIR)}
    found, made = LabFolder.objects.select_for_update().get_or_create(pk=1, defaults=ours)
    if made or found.lab_id == settings.EVA_LAB_ID:
        return
    if _running().filter(folder=True).exists():
        raise EvaError(_ANOTHER_FOLDER(theirs=found.path, host=found.host, ours=ours["path"]))
    log.warning(
        "the data folder of the lab was %s of %s; it is %s of %s", found.path, found.host, ours["path"], host
    )
    LabFolder.objects.filter(pk=1).update(**ours)


# --- workers -------------------------------------------------------------------------------------------------


def worker_seen(*, owner: UUID, queues: Sequence[str]) -> bool:
    """A sign of life of the worker, which is in the list from its first one; True."""
    told = {
        "host": socket.gethostname(),
        "queues": list(queues),
        "folder": has_lab_folder(),
        "seen_at": Now(),
    }
    WorkerProcess.objects.update_or_create(pk=owner, defaults=told)
    return True


def worker_ended(*, owner: UUID) -> None:
    """It takes no more; those that were never heard of again leave the list with it."""
    gone = Q(pk=owner) | Q(seen_at__lt=Now() - timedelta(seconds=_FORGOTTEN_S))
    WorkerProcess.objects.filter(gone).delete()


def _running() -> QuerySet[WorkerProcess]:
    return WorkerProcess.objects.filter(seen_at__gte=Now() - timedelta(seconds=settings.EVA_JOB_STALE_S))


# --- jobs that nobody takes ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Served:
    """What the workers that run can take."""

    queues: frozenset[str]
    with_folder: frozenset[str]  # queues of those that have the lab's data folder

    def lacks(self, job: Job) -> str:
        """Why no running worker can take a job that waits, as a sentence; "" where one can, or it does not wait."""
        return self.lacks_for(job.kind, job.queue) if job.status == JobStatus.QUEUED else ""

    def lacks_for(self, kind: str, queue: str) -> str:
        """The same of a kind in a queue."""
        if not self.queues:
            return NOBODY
        if queue not in self.queues:
            return NO_QUEUE(queue=queue)
        try:
            folder = declared(kind).folder
        except UnknownKind:  # of another release: its worker knows it
            return ""
        return NO_FOLDER(queue=queue) if folder and queue not in self.with_folder else ""


def served() -> Served:
    """By the workers that have been heard of within EVA_JOB_STALE_S."""
    rows = list(_running().values_list("queues", "folder"))
    return Served(
        frozenset(queue for queues, _ in rows for queue in queues),
        frozenset(queue for queues, folder in rows if folder for queue in queues),
    )


def waiting_for(job: Job) -> str:
    """Why no running worker can take it, "" where one can."""
    return served().lacks(job) if job.status == JobStatus.QUEUED else ""


def queue_names(given: str) -> list[str]:
    """Queues as an option names them, each once, in their order; EvaError says which are allowed."""
    asked = {name.strip() for name in given.split(",") if name.strip()}
    if not asked or not asked <= set(Queue):
        raise EvaError(f"--queues {given!r:.120}: allowed: {', '.join(Queue)}, with commas between them")
    return [queue.value for queue in Queue if queue in asked]
