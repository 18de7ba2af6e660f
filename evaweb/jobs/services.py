"""Jobs: asked for, claimed, done, tried again, swept. The row is the truth; the process that updates it first has it.

Its owner is a process, by a uuid of its own. Times are the database's, in the statements that write and compare them:
no clock of a worker decides about another one.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import ExitStack
from datetime import timedelta
from functools import partial
from typing import Any
from uuid import UUID, uuid4

from django.conf import settings
from django.db import IntegrityError, connection, transaction
from django.db.models import F, QuerySet
from django.db.models.functions import Now

from evaweb.errors import Conflict
from evaweb.jobs import doorbell
from evaweb.jobs.database_retry import retry_while_locked
from evaweb.jobs.heartbeat import Heartbeat, Lapse
from evaweb.jobs.kinds import Args, Cancelled, JobContext, TakenOver, declared, kind_named, least_role
from evaweb.jobs.locks import ClaimantState, claimant_state, exclusive_job
from evaweb.jobs.models import Hold, Job, JobStatus
from evaweb.jobs.selectors import jobs_ready
from evaweb.jobs.workers import has_lab_folder
from evaweb.roles import Role, require_role
from runtime.core.sentences import Pattern

log = logging.getLogger(__name__)
_JOB_ONLY_ONE_FAILED_TRIED = Pattern(
    "jobs.services.job_only_one_failed_tried",
    "job {job} ({key}) is {status}: only one that failed is tried again",
)
_JOB_THERE_NOTHING_CANCEL = Pattern(
    "jobs.services.job_there_nothing_cancel",
    "job {job} ({key}) is {status}: there is nothing to cancel",
)

RETRY_AFTER_S = (2.0, 10.0, 60.0)
MOST_ATTEMPTS = len(RETRY_AFTER_S) + 1
MOST_DEATHS = 8  # of workers over one job, which is no fault of its own most of the time
_LAPSES = 0.75  # of EVA_JOB_STALE_S, after which a worker that the database has not heard ends
_HOLD_AGAIN_S = 0.5
_AGAIN_S = 5.0  # after which a job is looked at again that another process is still at
OWNER = uuid4()  # this process

_busy = threading.Lock()
_ending = threading.Event()


# --- asking --------------------------------------------------------------------------------------------------


def enqueue(*, kind: str, key: str, args: Args) -> Job:
    """Ask for a job, in the queue of its kind; where one of that key waits already, it is that one, with these args.

    A job of that key which is running does not count: what it is about may have changed since it looked.
    """
    queue = declared(kind).queue
    with transaction.atomic():
        job = _waiting(kind, key, args, queue)
        transaction.on_commit(partial(doorbell.notify_workers, queue))
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


def retry_job(*, user: Any, job: Job) -> Job:
    """Ask anew for what a failed job was about, by a user who may ask for it; Conflict where it has not failed."""
    require_role(user, least_role(job.kind, job.args))
    if job.status != JobStatus.FAILED:
        raise Conflict(_JOB_ONLY_ONE_FAILED_TRIED(job=job.pk, key=job.key, status=job.get_status_display()))
    return enqueue(kind=job.kind, key=job.key, args=job.args)


@transaction.atomic
def cancel(*, user: Any, job: Job) -> Job:
    """End a job, for good: at once where it waits, else at its next step. Operators; Conflict where it has ended."""
    require_role(user, Role.OPERATOR)
    row = Job.objects.filter(pk=job.pk)
    waiting = row.filter(status=JobStatus.QUEUED)
    ended = {"status": JobStatus.FAILED, "finished_at": Now(), "error": _cancelled_words(user)}
    asked = waiting.update(cancelled_by=user, **ended) or row.filter(status=JobStatus.RUNNING).update(
        cancelled_by=user
    )
    job.refresh_from_db()
    if not asked:
        raise Conflict(_JOB_THERE_NOTHING_CANCEL(job=job.pk, key=job.key, status=job.get_status_display()))
    log.info("job %s is cancelled by %s", job.key, user.get_username())
    return job


def _cancelled_words(user: Any) -> str:
    return f"cancelled by {user.get_username()}"


# --- working -------------------------------------------------------------------------------------------------


def claim(*, queue: str, owner: UUID) -> Job | None:
    """Take the oldest job that is ready and can be done here, None where there is none; of two workers one gets it."""
    folder = has_lab_folder()
    while (found := jobs_ready(queues=[queue], folder=folder).first()) is not None:
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


def run_queue(queue: str) -> int:
    """Do what is ready in `queue`, one job after the other; how many. None while this process is at work already."""
    if not _busy.acquire(blocking=False):
        return 0
    try:
        done = 0
        while not _ending.is_set() and (job := retry_while_locked(partial(claim, queue=queue, owner=OWNER))):
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
            if stack.enter_context(exclusive_job(job.key, job.owner)):
                ended = partial(job_done, job=job, result=_result_of(job))
            else:
                ended = partial(job_postponed, job=job)
        except TakenOver as taken:
            log.warning("%s", taken)
            return
        except Cancelled:
            ended = partial(_ended_if_cancelled, row=_ours(job))
        except Exception as error:  # whatever a job raises is its own, never the worker's
            log.warning("job %s failed: %s", job.key, error, exc_info=True)
            ended = partial(job_failed, job=job, error=str(error) or type(error).__name__)
        retry_while_locked(ended)


def _result_of(job: Job) -> Args:
    stale_s = settings.EVA_JOB_STALE_S
    # Where there may be workers of other machines, whose locks of files may not reach this one, a claim ends in time.
    lapse = None if connection.vendor == "sqlite" else Lapse(stale_s * _LAPSES, partial(_lapsed, job))
    with Heartbeat(partial(heartbeat, job=job), stale_s / 6, lapse):
        return kind_named(job.kind)(JobContext(job.args, partial(_tell, job), partial(hold, job)))


def _lapsed(job: Job) -> None:
    """End this process: another one may be at work on the job by now, and a job may be ended at any moment."""
    log.error(
        "job %s is not known to be ours any more: this worker ends before another one does the same", job.key
    )
    os._exit(1)


def hold(job: Job, names: Collection[str]) -> None:
    """Wait until no other job that is being done holds any of `names`, and hold them until the job ends.

    They replace what it held before, so that no two jobs wait for each other. Raises TakenOver or Cancelled.
    """
    while (by := retry_while_locked(partial(_held_by_another, job, sorted(set(names))))) is not None:
        _tell(job, f"waits for another job at work on the same: {by}")
        time.sleep(_HOLD_AGAIN_S)


def _held_by_another(job: Job, names: Sequence[str]) -> str | None:
    """The key of the job that holds one of the names; None once they are held by this one."""
    at_work = Hold.objects.filter(job__status=JobStatus.RUNNING, job__owner=F("owner"))
    Hold.objects.filter(job=job).delete()  # also where it has to wait
    try:
        with transaction.atomic():
            Hold.objects.filter(what__in=names).exclude(pk__in=at_work.values("pk")).delete()
            Hold.objects.bulk_create(Hold(what=name, job=job, owner=job.owner) for name in names)
    except IntegrityError:
        other = at_work.filter(what__in=names).exclude(job=job).values_list("job__key", flat=True).first()
        return other or "which has just ended"
    return None


def _tell(job: Job, progress: str) -> None:
    ours = _ours(job)
    if retry_while_locked(
        lambda: ours.filter(cancelled_by=None).update(progress=progress[:160], seen_at=Now())
    ):
        return
    if retry_while_locked(ours.exists):
        raise Cancelled
    raise TakenOver(f"job {job.key} was taken from {job.owner}, which goes no further with it")


def heartbeat(*, job: Job) -> bool:
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
    return _requeue_row(_ours(job), attempts=attempts, error=error, not_before=again)


def job_postponed(*, job: Job) -> bool:
    """Look at it again in a few seconds: the process that it was taken from has not ended yet."""
    why = "the worker that had it before is still at it: it is waited for; end that one if it hangs"
    log.warning("job %s: %s", job.key, why)
    return _requeue_row(_ours(job), progress=why, not_before=Now() + timedelta(seconds=_AGAIN_S))


def _finish(job: Job, **facts: Any) -> bool:
    finished = bool(_ours(job).update(finished_at=Now(), **facts))
    if not finished:
        log.warning("job %s was taken from %s: what it found is dropped", job.key, job.owner)
    return finished


def _ours(job: Job) -> QuerySet[Job]:
    """The row as long as it is this claim's."""
    return Job.objects.filter(pk=job.pk, status=JobStatus.RUNNING, owner=job.owner)


def _ended_if_cancelled(row: QuerySet[Job]) -> bool:
    """End it for good if somebody has asked for that."""
    by = row.exclude(cancelled_by=None).select_related("cancelled_by").first()
    if by is None:
        return False
    words = _cancelled_words(by.cancelled_by)
    return bool(row.update(status=JobStatus.FAILED, owner=None, finished_at=Now(), error=words))


def _requeue_row(row: QuerySet[Job], **facts: Any) -> bool:
    """Let it wait again, unless it was cancelled; where a newer one of its key waits, that one is done instead."""
    if _ended_if_cancelled(row):
        return True
    try:
        with transaction.atomic():
            return bool(row.update(status=JobStatus.QUEUED, owner=None, **facts))
    except IntegrityError:
        newer = {"error": "given up for a newer one of the same key", **facts, "not_before": None}
        return bool(row.update(status=JobStatus.FAILED, finished_at=Now(), **newer))


# --- what is left behind -------------------------------------------------------------------------------------


def reclaim_stale_jobs() -> int:
    """Take jobs back from workers that have ended or show no sign of life; how many. Any process may do it at any time.

    One that is known to be at work keeps its job; one that is known to have ended is not waited for.
    """
    return sum(_reclaim(job) for job in Job.objects.filter(status=JobStatus.RUNNING))


def _reclaim(job: Job) -> bool:
    worker, row = claimant_state(job.key, job.owner), _ours(job)
    if worker is ClaimantState.UNKNOWN:
        row = row.filter(seen_at__lt=Now() - timedelta(seconds=settings.EVA_JOB_STALE_S))
    if worker is ClaimantState.ALIVE or not row.exists():
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
    return _requeue_row(row, deaths=deaths, error=silence, not_before=again)


def requeue(*, owner: UUID) -> int:
    """Let the jobs of a process that is about to end wait for another one; that is no death."""
    mine = Job.objects.filter(status=JobStatus.RUNNING, owner=owner)
    return sum(_requeue_row(_ours(job)) for job in mine)


def stop_claiming() -> None:
    """Claim nothing any more in this process; what is being done goes on."""
    _ending.set()
