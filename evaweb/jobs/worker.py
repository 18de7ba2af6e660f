"""Worker process: celery notifies it of new jobs, and it polls every few seconds in case a notification was lost.

Jobs are executed one at a time, except those of the queue `copies`: of these, EVA_COPIES are executed beside the
others, because each mostly waits for a process of its own.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from functools import partial

from celery.worker import state as celery_state
from django.conf import settings
from django.db import close_old_connections, connection

from evaweb.celery import app
from evaweb.core.lock_wait import retry_while_locked
from evaweb.jobs import services, workers
from evaweb.jobs.heartbeat import Heartbeat
from evaweb.jobs.kinds import Queue, periodic_tasks, startup_tasks

log = logging.getLogger(__name__)

LOOK_EVERY_S = 3.0
BROKER_AGAIN_S = 30.0
_copies_wait = threading.Event()  # jobs of the queue `copies` may be ready


def run_worker(queues: Sequence[str], *, lifeline: bool) -> None:
    """Execute jobs until SIGTERM, SIGINT or, with `lifeline`, the end of standard input.

    A job that is running at that moment may still finish. If it takes longer than EVA_WORKER_GRACE_S [s], it is
    requeued, and this process exits.
    """
    os.nice(settings.EVA_WORKER_NICE)
    if not settings.EVA_COPIES:
        queues = [queue for queue in queues if queue != Queue.COPIES]
    ending = _ending_by_signal()
    if lifeline:
        threading.Thread(target=_watch_input, name="lifeline", daemon=True).start()
    looking = threading.Thread(target=_poll, args=(queues, ending), name="looking")
    looking.start()
    for number in range(settings.EVA_COPIES * (Queue.COPIES in queues)):
        threading.Thread(target=_work_on_copies, args=(ending,), name=f"copy-{number}", daemon=True).start()
    heartbeat = Heartbeat(
        partial(workers.record_heartbeat, owner=services.OWNER, queues=queues), settings.EVA_JOB_STALE_S / 6
    )
    log.info("worker %s works on %s in %s", services.OWNER, ", ".join(queues), settings.DATA_DIR)
    with heartbeat:
        while not ending.is_set():
            _answer_doorbell(queues)
            if not ending.is_set():
                log.error(
                    "no doorbell for %g s; jobs are looked for every %g s", BROKER_AGAIN_S, LOOK_EVERY_S
                )
                ending.wait(BROKER_AGAIN_S)
        looking.join()
    _attempt("trials at copies", partial(retry_while_locked, partial(services.requeue, owner=services.OWNER)))
    _attempt("leaving the list of workers", partial(workers.worker_ended, owner=services.OWNER))
    log.info("the worker has ended")


def _ending_by_signal() -> threading.Event:
    ending = threading.Event()

    def end(number: int, frame: object) -> None:
        if ending.is_set():
            return
        ending.set()
        services.stop_claiming()
        celery_state.should_stop = 0  # as celery's own signal handler would set it
        threading.Thread(target=_put_back_later, name="grace", daemon=True).start()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, end)
    return ending


def _put_back_later() -> None:
    """Requeue the job and exit at the end of the grace period; every job can be killed and run again."""
    threading.Event().wait(settings.EVA_WORKER_GRACE_S)
    try:
        count = retry_while_locked(lambda: services.requeue(owner=services.OWNER))
        log.warning("not done within %g s of grace: %d put back", settings.EVA_WORKER_GRACE_S, count)
    finally:
        os._exit(0)  # a job that could not be requeued is reclaimed by others


def _watch_input() -> None:
    while os.read(sys.stdin.fileno(), 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


def _answer_doorbell(queues: Sequence[str]) -> None:
    """Run celery in this thread until it is stopped; return early if the broker does not work."""
    worker = app.WorkController(
        pool="solo",
        concurrency=1,
        queues=list(queues),
        hostname=f"eva-{services.OWNER}@%h",
        without_gossip=True,
        without_mingle=True,
        without_heartbeat=True,
    )
    worker.start()


def _poll(queues: Sequence[str], ending: threading.Event) -> None:
    """Reclaim stale jobs, run periodic tasks, and execute ready jobs, without waiting for the doorbell."""
    _attempt(
        "list of workers",
        partial(retry_while_locked, partial(workers.record_heartbeat, owner=services.OWNER, queues=queues)),
    )
    begun = False
    while not ending.is_set():
        close_old_connections()
        _attempt("sweep", partial(retry_while_locked, services.reclaim_stale_jobs))
        if Queue.CPU in queues and _attempt(
            "the data folder", partial(retry_while_locked, workers.has_lab_folder)
        ):
            for name, task in {
                **(periodic_tasks() if begun else startup_tasks()),
                **periodic_tasks(),
            }.items():
                _attempt(name, partial(retry_while_locked, task))
            begun = True
        for queue in queues:
            if queue != Queue.COPIES:
                _attempt(f"queue {queue}", partial(services.run_queue, queue))
        ending.wait(LOOK_EVERY_S)
    connection.close()


def wake_copies() -> None:
    """Let the threads look for ready jobs of the queue `copies`."""
    _copies_wait.set()


def _work_on_copies(ending: threading.Event) -> None:
    """Execute ready jobs of the queue `copies`; the end of this process ends them, and each is carried on elsewhere."""
    while not ending.is_set():
        close_old_connections()
        _attempt("queue copies", partial(services.work_off, Queue.COPIES))
        if _copies_wait.wait(LOOK_EVERY_S):
            _copies_wait.clear()
    connection.close()


def _attempt(name: str, action: Callable[[], object]) -> object:
    """Return the result of `action`; None if it failed."""
    try:
        return action()
    except Exception:  # any error: this thread must reach the next poll
        log.exception("%s failed, again in %g s", name, LOOK_EVERY_S)
        connection.close()
        return None
