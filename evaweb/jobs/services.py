"""Jobs: asked for, claimed, done, tried again, swept. The row is the truth; the process that updates it first has it.

Its owner is a process, by a uuid of its own. Times are the database's, in the statements that write and compare them:
no clock of a worker decides about another one.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import ExitStack
from datetime import timedelta
from functools import partial
from typing import Any
from uuid import UUID, uuid4

from django.conf import settings
from django.db import IntegrityError, transaction
from django.db.models import QuerySet
from django.db.models.functions import Now

from evaweb.errors import Conflict
from evaweb.jobs import doorbell
from evaweb.jobs.database_retry import patiently
from evaweb.jobs.heartbeat import Heartbeat
from evaweb.jobs.kinds import Args, TakenOver, Work, kind_named
from evaweb.jobs.locks import Worker, alone, worker_of
from evaweb.jobs.models import Job, JobStatus
from evaweb.jobs.selectors import jobs_ready

log = logging.getLogger(__name__)

RETRY_AFTER_S = (2.0, 10.0, 60.0)
MOST_ATTEMPTS = len(RETRY_AFTER_S) + 1
MOST_DEATHS = 8  # of workers over one job, which is no fault of its own most of the time
_AGAIN_S = 5.0  # after which a job is looked at again that another process is still at
OWNER = uuid4()  # this process

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
        if asked.update(kind=kind, args=dict(args), queue=queue, not_before=None, attempts=0, deaths=0):
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


def claim(*, queue: str, owner: UUID) -> Job | None:
    """Take the oldest job that is ready, None where there is none; of two workers one gets it."""
    while (found := jobs_ready(queues=[queue]).first()) is not None:
        taken = Job.objects.filter(pk=found.pk, status=JobStatus.QUEUED).update(
            status=JobStatus.RUNNING,
            owner=owner,
            claimed_at=Now(),
            seen_at=Now(),
            finished_at=None,
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
        while not _ending.is_set() and (job := patiently(partial(claim, queue=queue, owner=OWNER))):
            _perform(job)
            done += 1
        return done
    finally:
        _busy.release()


def _perform(job: Job) -> None:
    """Do it and write down what came of it, while no other process on this disk does the same."""
    log.info("job %s begins after %d errors and %d deaths", job.key, job.attempts, job.deaths)
    with ExitStack() as stack:
        ended: Callable[[], object]
        try:
            if stack.enter_context(alone(job.key, job.owner)):
                ended = partial(job_done, job=job, result=_result_of(job))
            else:
                ended = partial(job_postponed, job=job)
        except TakenOver as taken:
            log.warning("%s", taken)
            return
        except Exception as error:  # whatever a job raises is its own, never the worker's
            log.warning("job %s failed: %s", job.key, error, exc_info=True)
            ended = partial(job_failed, job=job, error=str(error) or type(error).__name__)
        patiently(ended)


def _result_of(job: Job) -> Args:
    with Heartbeat(partial(seen, job=job), settings.EVA_JOB_STALE_S / 6):
        return kind_named(job.kind)(Work(job.args, partial(_tell, job)))


def _tell(job: Job, progress: str) -> None:
    if not patiently(lambda: _ours(job).update(progress=progress[:160], seen_at=Now())):
        raise TakenOver(f"job {job.key} was taken from {job.owner}, which goes no further with it")


def seen(*, job: Job) -> bool:
    """A sign of life; False where the job is not this claim's any more."""
    return bool(_ours(job).update(seen_at=Now()))


def job_done(*, job: Job, result: Args) -> bool:
    """Keep the result; False where the job was swept meanwhile, and its new owner says how it ends."""
    done = _finish(job, status=JobStatus.DONE, result=dict(result), error="", progress="")
    if done:
        log.info("job %s is done: %s", job.key, dict(result))
    return done


def job_failed(*, job: Job, error: str) -> bool:
    """Keep the error and let the job wait for its next attempt, or fail for good after the last one."""
    attempts = job.attempts + 1
    if attempts >= MOST_ATTEMPTS:
        return _finish(job, status=JobStatus.FAILED, attempts=attempts, error=error)
    again = Now() + timedelta(seconds=RETRY_AFTER_S[attempts - 1])
    return _waits(_ours(job), attempts=attempts, error=error, not_before=again)


def job_postponed(*, job: Job) -> bool:
    """Look at it again in a few seconds: the process that it was taken from has not ended yet."""
    why = "the worker that had it before is still at it: it is waited for; end that one if it hangs"
    log.warning("job %s: %s", job.key, why)
    return _waits(_ours(job), progress=why, not_before=Now() + timedelta(seconds=_AGAIN_S))


def _finish(job: Job, **facts: Any) -> bool:
    finished = bool(_ours(job).update(finished_at=Now(), **facts))
    if not finished:
        log.warning("job %s was taken from %s: what it found is dropped", job.key, job.owner)
    return finished


def _ours(job: Job) -> QuerySet[Job]:
    """The row as long as it is this claim's."""
    return Job.objects.filter(pk=job.pk, status=JobStatus.RUNNING, owner=job.owner)


def _waits(row: QuerySet[Job], **facts: Any) -> bool:
    """Let it wait again; where a newer one of its key waits already, that one is done instead."""
    try:
        with transaction.atomic():
            return bool(row.update(status=JobStatus.QUEUED, owner=None, **facts))
    except IntegrityError:
        newer = {"error": "given up for a newer one of the same key", **facts, "not_before": None}
        return bool(row.update(status=JobStatus.FAILED, finished_at=Now(), **newer))


# --- what is left behind -------------------------------------------------------------------------------------


def sweep() -> int:
    """Take jobs back from workers that have ended or show no sign of life; how many. Any process may do it at any time.

    One that is known to be at work keeps its job; one that is known to have ended is not waited for.
    """
    return sum(_take_back(job) for job in Job.objects.filter(status=JobStatus.RUNNING))


def _take_back(job: Job) -> bool:
    worker, row = worker_of(job.key, job.owner), _ours(job)
    if worker is Worker.UNKNOWN:
        row = row.filter(seen_at__lt=Now() - timedelta(seconds=settings.EVA_JOB_STALE_S))
    if worker is Worker.ALIVE or not row.exists():
        return False
    deaths = job.deaths + 1
    silence = f"its worker {job.owner} ended or went silent, which is number {deaths} of {MOST_DEATHS}"
    if deaths >= MOST_DEATHS:
        hint = "the worker's log says what ended them; then try it again"
        facts = {"status": JobStatus.FAILED, "finished_at": Now(), "error": f"{silence}: {hint}"}
        return bool(row.update(deaths=deaths, **facts))
    log.warning("job %s is taken back: %s", job.key, silence)
    wait = (0.0, *RETRY_AFTER_S)[min(deaths - 1, len(RETRY_AFTER_S))]  # others have their turn meanwhile
    # None is at once also for whoever looks within this millisecond.
    again = Now() + timedelta(seconds=wait) if wait else None
    return _waits(row, deaths=deaths, error=silence, not_before=again)


def put_back(*, owner: UUID) -> int:
    """Let the jobs of a process that is about to end wait for another one; that is no death."""
    mine = Job.objects.filter(status=JobStatus.RUNNING, owner=owner)
    return sum(_waits(_ours(job)) for job in mine)


def end_work() -> None:
    """Claim nothing any more in this process; what is being done goes on."""
    _ending.set()
