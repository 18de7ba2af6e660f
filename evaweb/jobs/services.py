"""Services for jobs: enqueue, claim, execute, retry, reclaim. A conditional update of the row decides who has a job.

The owner of a job is a process, identified by a random uuid. All times are the database's, in the statements that write
and compare them, so that no worker's clock affects another's jobs.
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

from evaweb.accounts.roles import Role, require_role
from evaweb.core.errors import Conflict, NotAllowed
from evaweb.core.lock_wait import retry_while_locked
from evaweb.jobs import doorbell
from evaweb.jobs.heartbeat import Heartbeat, Lapse
from evaweb.jobs.kinds import (
    ORDERED_BY,
    Args,
    Cancelled,
    JobContext,
    JobTakenOver,
    JobUnfinished,
    declared,
    kind_named,
    least_role,
)
from evaweb.jobs.locks import ClaimantState, claimant_state, exclusive_job
from evaweb.jobs.models import Hold, Job, JobStatus
from evaweb.jobs.selectors import jobs_ready
from evaweb.jobs.workers import has_lab_folder
from runtime.core.sentences import Pattern

log = logging.getLogger(__name__)
_JOB_ONLY_ONE_FAILED_TRIED = Pattern(
    "jobs.services.job_only_one_failed_tried",
    "job {job} ({key}) is {status}: only one that failed is tried again",
)
_STARTED_ELSEWHERE = Pattern(
    "jobs.services.started_elsewhere",
    "job {job} ({key}) is not tried again as it was: start it anew {elsewhere}",
)
_OF_ANOTHER = Pattern(
    "jobs.services.of_another",
    "job {job} ({key}) uses an account of the person who ordered it: order it yourself, or let them try it again",
)
_JOB_THERE_NOTHING_CANCEL = Pattern(
    "jobs.services.job_there_nothing_cancel",
    "job {job} ({key}) is {status}: there is nothing to cancel",
)

RETRY_AFTER_S = (2.0, 10.0, 60.0)
MOST_ATTEMPTS = len(RETRY_AFTER_S) + 1
MOST_DEATHS = 8  # workers that may die over one job, mostly not through its fault
_LAPSES = 0.75  # fraction of EVA_JOB_STALE_S without a heartbeat after which a worker exits
_HOLD_AGAIN_S = 0.5
_AGAIN_S = 5.0  # delay before a job is retried that another process still holds
OWNER = uuid4()  # identity of this process

_busy = threading.Lock()
_ending = threading.Event()


# --- asking --------------------------------------------------------------------------------------------------


def enqueue(*, kind: str, key: str, args: Args) -> Job:
    """Queue a job; if one with that key is already queued, update its args and return it.

    A running job with that key is not enough, because its subject may have changed since that job read it.
    """
    queue = declared(kind).queue
    with transaction.atomic():
        job = _waiting(kind, key, args, queue)
        transaction.on_commit(partial(doorbell.notify_workers, queue))
    return job


def _waiting(kind: str, key: str, args: Args, queue: str) -> Job:
    for _ in range(3):
        queued = Job.objects.filter(key=key, status=JobStatus.QUEUED)
        if queued.update(kind=kind, args=dict(args), queue=queue, not_before=None, attempts=0, deaths=0):
            job = queued.first()
            if job is not None:
                return job
        try:
            with transaction.atomic():
                return Job.objects.create(kind=kind, key=key, args=dict(args), queue=queue)
        except IntegrityError:  # the same was requested concurrently
            continue
    raise RuntimeError(f"job {key} is claimed faster than it can be asked for")


def retry_job(*, user: Any, job: Job) -> Job:
    """Queue a failed job again. Raises: Conflict unless it has failed; NotAllowed if the user may not request it."""
    require_role(user, least_role(job.kind, job.args))
    if job.args.get(ORDERED_BY, user.pk) != user.pk:
        raise NotAllowed(_OF_ANOTHER(job=job.pk, key=job.key))
    if elsewhere := declared(job.kind).start:
        raise Conflict(_STARTED_ELSEWHERE(job=job.pk, key=job.key, elsewhere=elsewhere))
    if job.status != JobStatus.FAILED:
        raise Conflict(_JOB_ONLY_ONE_FAILED_TRIED(job=job.pk, key=job.key, status=job.get_status_display()))
    return enqueue(kind=job.kind, key=job.key, args=job.args)


@transaction.atomic
def cancel(*, user: Any, job: Job) -> Job:
    """Cancel a job: immediately if queued, else at its next step. Raises: Conflict if it has ended."""
    require_role(user, Role.OPERATOR)
    row = Job.objects.filter(pk=job.pk)
    waiting = row.filter(status=JobStatus.QUEUED)
    ended = {"status": JobStatus.FAILED, "finished_at": Now(), "error": _cancelled_words(user)}
    updated = waiting.update(cancelled_by=user, **ended) or row.filter(status=JobStatus.RUNNING).update(
        cancelled_by=user
    )
    job.refresh_from_db()
    if not updated:
        raise Conflict(_JOB_THERE_NOTHING_CANCEL(job=job.pk, key=job.key, status=job.get_status_display()))
    log.info("job %s is cancelled by %s", job.key, user.get_username())
    return job


def _cancelled_words(user: Any) -> str:
    return f"cancelled by {user.get_username()}"


# --- working -------------------------------------------------------------------------------------------------


def claim(*, queue: str, owner: UUID, keys: str = "") -> Job | None:
    """Claim the oldest ready job that this process can do; None if there is none. Of two workers only one gets it.

    `keys` is how the keys of these jobs begin.
    """
    folder = has_lab_folder()
    while (ready := jobs_ready(queues=[queue], folder=folder, keys=keys).first()) is not None:
        claimed = Job.objects.filter(pk=ready.pk, status=JobStatus.QUEUED).update(
            status=JobStatus.RUNNING,
            owner=owner,
            claimed_at=Now(),
            seen_at=Now(),
            finished_at=None,
            progress="",
        )
        if claimed:
            return Job.objects.get(pk=ready.pk)
    return None


def run_queue(queue: str) -> int:
    """Execute the ready jobs of `queue` one after the other and return their number.

    If this process is executing jobs already, nothing is done and 0 is returned.
    """
    if not _busy.acquire(blocking=False):
        return 0
    try:
        return work_off(queue)
    finally:
        _busy.release()


def work_off(queue: str, keys: str = "") -> int:
    """Execute the ready jobs of `queue` whose keys begin with `keys`, until none is left; return their number.

    Several threads may do so at the same time.
    """
    count = 0
    while not _ending.is_set() and (
        job := retry_while_locked(partial(claim, queue=queue, owner=OWNER, keys=keys))
    ):
        _perform(job)
        count += 1
    return count


def _perform(job: Job) -> None:
    """Execute a job and record its outcome, with a lock that excludes other processes on this disk."""
    log.info("job %s begins after %d errors and %d deaths", job.key, job.attempts, job.deaths)
    with ExitStack() as stack:
        ended: Callable[[], object]
        try:
            if stack.enter_context(exclusive_job(job.key, job.owner)):
                ended = partial(job_done, job=job, result=_result_of(job))
            else:
                ended = partial(job_postponed, job=job)
        except JobTakenOver as taken:
            log.warning("%s", taken)
            return
        except Cancelled:
            ended = partial(_ended_if_cancelled, row=_ours(job))
        except JobUnfinished as rest:
            ended = partial(job_unfinished, job=job, after_s=rest.after_s)
        except Exception as error:  # an exception fails the job, never the worker
            log.warning("job %s failed: %s", job.key, error, exc_info=True)
            ended = partial(job_failed, job=job, error=str(error) or type(error).__name__)
        retry_while_locked(ended)


def _result_of(job: Job) -> Args:
    stale_s = settings.EVA_JOB_STALE_S
    # File locks may not reach workers on other machines; there a claim must end before the database reclaims it.
    lapse = None if connection.vendor == "sqlite" else Lapse(stale_s * _LAPSES, partial(_lapsed, job))
    with Heartbeat(partial(heartbeat, job=job), stale_s / 6, lapse):
        return kind_named(job.kind)(JobContext(job.args, partial(_tell, job), partial(hold, job)))


def _lapsed(job: Job) -> None:
    """Exit this process, because another worker may have claimed the job.

    This is safe because every job may be killed at any moment and run again.
    """
    log.error(
        "job %s is not known to be ours any more: this worker ends before another one does the same", job.key
    )
    os._exit(1)


def hold(job: Job, names: Collection[str]) -> None:
    """Wait until no other running job holds any of `names`, then hold them until this job ends.

    A name stands for something that only one job may work on, such as a dataset. The new names replace those that this
    job held before, so that two jobs cannot deadlock.

    Raises:
        JobTakenOver: If another worker has the job now.
        Cancelled: If the job was cancelled.
    """
    while (by := retry_while_locked(partial(_acquire_names, job, sorted(set(names))))) is not None:
        _tell(job, f"waits for another job at work on the same: {by}")
        time.sleep(_HOLD_AGAIN_S)


def _acquire_names(job: Job, names: Sequence[str]) -> str | None:
    """Hold the names if they are free and return None; else return the key of the job that holds one."""
    at_work = Hold.objects.filter(job__status=JobStatus.RUNNING, job__owner=F("owner"))
    Hold.objects.filter(job=job).delete()  # released even if it has to wait, so that jobs cannot deadlock
    try:
        with transaction.atomic():
            Hold.objects.filter(what__in=names).exclude(pk__in=at_work.values("pk")).delete()
            Hold.objects.bulk_create(Hold(what=name, job=job, owner=job.owner) for name in names)
    except IntegrityError:
        key = at_work.filter(what__in=names).exclude(job=job).values_list("job__key", flat=True).first()
        return key or "which has just ended"
    return None


def _tell(job: Job, progress: str) -> None:
    own = _ours(job)
    if retry_while_locked(
        lambda: own.filter(cancelled_by=None).update(progress=progress[:160], seen_at=Now())
    ):
        return
    if retry_while_locked(own.exists):
        raise Cancelled
    raise JobTakenOver(f"job {job.key} was taken from {job.owner}, which goes no further with it")


def heartbeat(*, job: Job) -> bool:
    """Record a heartbeat of the job; return False if this process has lost its claim to the job."""
    return bool(_ours(job).update(seen_at=Now()))


def job_done(*, job: Job, result: Args) -> bool:
    """Record the result of the job, and return True.

    If another worker has reclaimed the job meanwhile, the result is dropped and False is returned: the new owner of the
    job records its outcome.
    """
    finished = _finish(job, status=JobStatus.DONE, result=dict(result), error="", progress="")
    if finished:
        log.info("job %s is done: %s", job.key, dict(result))
    return finished


def job_failed(*, job: Job, error: str) -> bool:
    """Record the error and queue the next attempt after a delay; fail the job for good after the last attempt."""
    attempts = job.attempts + 1
    if attempts >= MOST_ATTEMPTS:
        return _finish(job, status=JobStatus.FAILED, attempts=attempts, error=error)
    not_before = Now() + timedelta(seconds=RETRY_AFTER_S[attempts - 1])
    return _requeue_row(_ours(job), attempts=attempts, error=error, not_before=not_before)


def job_unfinished(*, job: Job, after_s: float) -> bool:
    """Queue the job again in `after_s` [s], unless it was cancelled: it has done a part of its work."""
    facts = {"attempts": 0, "deaths": 0, "error": "", "not_before": Now() + timedelta(seconds=after_s)}
    return _requeue_row(_ours(job), **facts)


def job_postponed(*, job: Job) -> bool:
    """Queue the job again after a few seconds: the process that had it before has not ended yet."""
    reason = "the worker that had it before is still at it: it is waited for; end that one if it hangs"
    log.warning("job %s: %s", job.key, reason)
    return _requeue_row(_ours(job), progress=reason, not_before=Now() + timedelta(seconds=_AGAIN_S))


def _finish(job: Job, **facts: Any) -> bool:
    finished = bool(_ours(job).update(finished_at=Now(), **facts))
    if not finished:
        log.warning("job %s was taken from %s: what it found is dropped", job.key, job.owner)
    return finished


def _ours(job: Job) -> QuerySet[Job]:
    """Return the job's row as a queryset, which is empty if this process's claim is lost."""
    return Job.objects.filter(pk=job.pk, status=JobStatus.RUNNING, owner=job.owner)


def _ended_if_cancelled(row: QuerySet[Job]) -> bool:
    """Fail the job for good if a user has cancelled it; return True if so."""
    by = row.exclude(cancelled_by=None).select_related("cancelled_by").first()
    if by is None:
        return False
    text = _cancelled_words(by.cancelled_by)
    return bool(row.update(status=JobStatus.FAILED, owner=None, finished_at=Now(), error=text))


def _requeue_row(row: QuerySet[Job], **facts: Any) -> bool:
    """Queue the job again unless it was cancelled.

    If a newer job with the same key is queued already, this job is failed, and the newer one does its work.
    """
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
    """Reclaim jobs of workers that have ended or send no heartbeat; return their number. Any process may call it.

    A worker known to be alive keeps its job; one known to have ended loses it immediately.
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
    wait = (0.0, *RETRY_AFTER_S)[min(deaths - 1, len(RETRY_AFTER_S))]  # lets other jobs run meanwhile
    # None is ready immediately, Now() only after this instant.
    not_before = Now() + timedelta(seconds=wait) if wait else None
    return _requeue_row(row, deaths=deaths, error=silence, not_before=not_before)


def requeue(*, owner: UUID) -> int:
    """Requeue the running jobs of a worker that is shutting down, and return their number.

    The end of this worker is not counted as one of the deaths after which a job fails.
    """
    mine = Job.objects.filter(status=JobStatus.RUNNING, owner=owner)
    return sum(_requeue_row(_ours(job)) for job in mine)


def stop_claiming() -> None:
    """Claim no more jobs in this process; a running one continues."""
    _ending.set()
