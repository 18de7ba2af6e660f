"""Jobs: asked for, claimed, done, tried again, swept. The row is the truth; whoever updates it first has it."""

from __future__ import annotations

import logging
import os
import socket
import threading
import uuid
from collections.abc import Callable
from datetime import datetime, timedelta
from functools import partial
from typing import Any

from django.conf import settings
from django.db import IntegrityError, transaction
from django.db.models import F, QuerySet
from django.utils import timezone

from evaweb.errors import Conflict
from evaweb.jobs import doorbell
from evaweb.jobs.heartbeat import Heartbeat
from evaweb.jobs.kinds import Args, Work, kind_named
from evaweb.jobs.models import Job, JobStatus
from evaweb.jobs.patience import patiently
from evaweb.jobs.selectors import jobs_ready

log = logging.getLogger(__name__)

RETRY_AFTER_S = (2.0, 10.0, 60.0)
MOST_ATTEMPTS = len(RETRY_AFTER_S) + 1

_busy = threading.Lock()
_ending = threading.Event()


# --- asking --------------------------------------------------------------------------------------------------


def enqueue(*, kind: str, key: str, args: Args, queue: str = "lab") -> Job:
    """Ask for a job; where one of that key waits already, it is that one, with these args.

    A job of that key which is running does not count: what it is about may have changed since it looked.
    """
    kind_named(kind)
    with transaction.atomic():
        job = _waiting(kind, key, args, queue)
        transaction.on_commit(partial(doorbell.ring, queue))
    return job


def _waiting(kind: str, key: str, args: Args, queue: str) -> Job:
    for _ in range(3):
        asked = Job.objects.filter(key=key, status=JobStatus.QUEUED)
        if asked.update(kind=kind, args=dict(args), queue=queue, not_before=None, attempts=0):
            found = asked.first()
            if found is not None:
                return found
        try:
            with transaction.atomic():
                return Job.objects.create(kind=kind, key=key, args=dict(args), queue=queue)
        except IntegrityError:  # somebody asked for the same just now
            continue
    raise RuntimeError(f"job {key} is claimed faster than it can be asked for")


def try_again(*, job: Job) -> Job:
    """Ask anew for what a failed job was about; Conflict where it has not failed."""
    if job.status != JobStatus.FAILED:
        raise Conflict(
            f"job {job.pk} ({job.key}) is {job.get_status_display()}: only one that failed is tried again"
        )
    return enqueue(kind=job.kind, key=job.key, args=job.args, queue=job.queue)


# --- working -------------------------------------------------------------------------------------------------


def claim(*, queue: str, worker: str) -> Job | None:
    """Take the oldest job that is ready, None where there is none; of two workers one gets it."""
    while (found := jobs_ready(queues=[queue], now=timezone.now()).first()) is not None:
        now = timezone.now()
        taken = Job.objects.filter(pk=found.pk, status=JobStatus.QUEUED).update(
            status=JobStatus.RUNNING,
            claimed_by=worker,
            claimed_at=now,
            seen_at=now,
            finished_at=None,
            attempts=F("attempts") + 1,
            progress="",
        )
        if taken:
            return Job.objects.get(pk=found.pk)
    return None


def work(queue: str) -> int:
    """Do what is ready in `queue`, one job after the other; how many. None while this process is at work already."""
    if not _busy.acquire(blocking=False):
        return 0
    try:
        done = 0
        while not _ending.is_set() and (job := patiently(lambda: _claim_one(queue))) is not None:
            _perform(job)
            done += 1
        return done
    finally:
        _busy.release()


def _claim_one(queue: str) -> Job | None:
    return claim(queue=queue, worker=f"{socket.gethostname()}:{os.getpid()}:{uuid.uuid4().hex[:12]}")


def _perform(job: Job) -> None:
    log.info("job %s begins, attempt %d", job.key, job.attempts)
    try:
        with Heartbeat(partial(seen, job=job), settings.EVA_JOB_STALE_S / 6):
            result = kind_named(job.kind)(Work(job.args, _teller(job)))
    except Exception as error:  # whatever a job raises is its own, never the worker's
        log.warning("job %s failed, attempt %d: %s", job.key, job.attempts, error, exc_info=True)
        reason = str(error) or type(error).__name__
        patiently(lambda: job_failed(job=job, error=reason))
    else:
        if patiently(lambda: job_done(job=job, result=result)):
            log.info("job %s is done: %s", job.key, dict(result))


def _teller(job: Job) -> Callable[[str], None]:
    def tell(progress: str) -> None:
        patiently(lambda: _ours(job).update(progress=progress[:160], seen_at=timezone.now()))

    return tell


def seen(*, job: Job) -> bool:
    """A sign of life; False where the job is not this claim's any more."""
    return bool(_ours(job).update(seen_at=timezone.now()))


def job_done(*, job: Job, result: Args) -> bool:
    """Keep the result; False where the job was swept meanwhile, and whoever has it now says how it ends."""
    return _finish(job, status=JobStatus.DONE, result=dict(result), error="", progress="")


@transaction.atomic
def job_failed(*, job: Job, error: str) -> bool:
    """Keep the error and let the job wait for its next attempt, or fail for good after the last one."""
    if job.attempts >= MOST_ATTEMPTS or _asked_anew(job):
        return _finish(job, status=JobStatus.FAILED, error=error)
    again = timezone.now() + timedelta(seconds=RETRY_AFTER_S[job.attempts - 1])
    return bool(_ours(job).update(status=JobStatus.QUEUED, error=error, not_before=again, claimed_by=""))


def _finish(job: Job, **facts: Any) -> bool:
    finished = bool(_ours(job).update(finished_at=timezone.now(), **facts))
    if not finished:
        log.warning("job %s was taken from %s: what it found is dropped", job.key, job.claimed_by)
    return finished


def _ours(job: Job) -> QuerySet[Job]:
    """The row as long as it is this claim's."""
    return Job.objects.filter(pk=job.pk, status=JobStatus.RUNNING, claimed_by=job.claimed_by)


def _asked_anew(job: Job) -> bool:
    return Job.objects.filter(key=job.key, status=JobStatus.QUEUED).exists()


# --- what is left behind -------------------------------------------------------------------------------------


def sweep(*, now: datetime | None = None) -> int:
    """Take jobs back from workers that show no sign of life; how many. Any process may do it at any time.

    A worker of this machine whose process is gone is not waited for.
    """
    before = (now or timezone.now()) - timedelta(seconds=settings.EVA_JOB_STALE_S)
    running = Job.objects.filter(status=JobStatus.RUNNING)
    taken = sum(
        _take_back(job, _ours(job).filter(seen_at__lt=before)) for job in running.filter(seen_at__lt=before)
    )
    here = running.filter(claimed_by__startswith=f"{socket.gethostname()}:")
    return taken + sum(_take_back(job, _ours(job)) for job in here if _worker_is_gone(job))


def _worker_is_gone(job: Job) -> bool:
    """Whether the process on this machine that claimed the job has ended."""
    process = job.claimed_by.rsplit(":", 2)[1]
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return True
    except (PermissionError, ValueError):  # somebody else's process, or a claim that names none
        return False
    return False


@transaction.atomic
def _take_back(job: Job, row: QuerySet[Job]) -> int:
    silence = f"its worker {job.claimed_by} went silent in attempt {job.attempts}"
    if job.attempts >= MOST_ATTEMPTS or _asked_anew(job):
        return row.update(status=JobStatus.FAILED, error=silence, finished_at=timezone.now())
    log.warning("job %s is taken back: %s", job.key, silence)
    return row.update(status=JobStatus.QUEUED, error=silence, not_before=None, claimed_by="")


def put_back(*, worker_prefix: str) -> int:
    """Let the jobs of a process that is about to end wait for another one; the attempt does not count."""
    count = 0
    for job in Job.objects.filter(status=JobStatus.RUNNING, claimed_by__startswith=worker_prefix):
        with transaction.atomic():
            if _asked_anew(job):
                facts = {"status": JobStatus.FAILED, "error": "given up for a newer one of the same key"}
            else:
                facts = {"status": JobStatus.QUEUED, "claimed_by": "", "attempts": job.attempts - 1}
            count += _ours(job).update(**facts)
    return count


def end_work() -> None:
    """Claim nothing any more in this process; what is being done goes on."""
    _ending.set()


def own_prefix() -> str:
    """How the claims of this process begin."""
    return f"{socket.gethostname()}:{os.getpid()}:"
