"""Jobs for the episodes of a session: progress and remaining time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from uuid import UUID

from django.utils import timezone

from evaweb.collect.models import CollectSession
from evaweb.episodes.models import Episode
from evaweb.jobs.models import Job, JobStatus
from evaweb.jobs.workers import Served, served

KINDS = ("preview", "quality", "export", "publish", "sides")
_MEASURED = 20  # newest jobs of a kind from which its speed is estimated
_AT_ONCE = 500  # keys per query


@dataclass(frozen=True, slots=True)
class QueueItem:
    """Unfinished job: `number` of the episode in its session, remaining time `left_s` [s] if known."""

    job: Job
    episode: UUID
    number: int
    left_s: float | None
    expected_s: float | None
    lacks: str = ""  # reason why no running worker can execute it

    @property
    def fraction(self) -> float | None:
        """Finished fraction of the job, estimated from its expected duration."""
        if self.left_s is None or not self.expected_s or self.job.status != JobStatus.RUNNING:
            return None
        return min(1.0, max(0.0, 1 - self.left_s / self.expected_s))


@dataclass(frozen=True, slots=True)
class Queue:
    """Unfinished jobs for a session's episodes: first failed, then running, then queued ones.

    `done` is the number of jobs that are done. `left_s` is the total remaining time [s] if the jobs run one after
    another, None if it is unknown.
    """

    items: tuple[QueueItem, ...]
    done: int
    left_s: float | None

    @property
    def total(self) -> int:
        """Number of jobs, done or not, for the session's episodes: the newest of each kind for each episode."""
        return self.done + len(self.items)

    @property
    def active(self) -> bool:
        """Whether a job is running or queued. While this is so, the page has to poll."""
        return any(item.job.status != JobStatus.FAILED for item in self.items)

    @property
    def failed(self) -> int:
        """Number of failed jobs, which need a person."""
        return sum(item.job.status == JobStatus.FAILED for item in self.items)


def session_queue(*, session: CollectSession) -> Queue:
    """Return the newest job of each kind for each episode of the session."""
    in_order = session.demonstrations.order_by("episode__started_at", "episode__created_at")
    frames = {
        pk: (number, count)
        for number, (pk, count) in enumerate(in_order.values_list("pk", "episode__frames"), 1)
    }
    newest = _newest([f"{kind}:{uuid}" for uuid in frames for kind in KINDS])
    open_jobs = [job for job in newest if job.status != JobStatus.DONE]
    speeds = {kind: _seconds_per_frame(kind) for kind in {job.kind for job in open_jobs}}
    having = served()
    items = sorted((_item(job, frames, speeds, having) for job in open_jobs), key=_queue_order)
    waiting = [item.left_s for item in items if item.job.status != JobStatus.FAILED]
    estimates = [left for left in waiting if left is not None]
    return Queue(
        tuple(items), len(newest) - len(items), sum(estimates) if len(estimates) == len(waiting) else None
    )


def _newest(keys: Sequence[str]) -> list[Job]:
    by_key: dict[str, Job] = {}
    for part in _parts(keys):
        for job in Job.objects.filter(key__in=part).order_by("created_at", "pk"):
            by_key[job.key] = job
    return list(by_key.values())


def _parts(keys: Sequence[str]) -> Iterator[list[str]]:
    left = iter(keys)
    while part := list(islice(left, _AT_ONCE)):
        yield part


def _item(
    job: Job, frames: Mapping[UUID, tuple[int, int]], speeds: Mapping[str, float | None], having: Served
) -> QueueItem:
    uuid = UUID(job.key.partition(":")[2])
    number, count = frames[uuid]
    speed = speeds[job.kind]
    expected = left = None if speed is None else speed * max(count, 1)
    if left is not None and job.status == JobStatus.RUNNING and job.claimed_at is not None:
        left = max(0.0, left - (timezone.now() - job.claimed_at).total_seconds())
    return QueueItem(
        job, uuid, number, None if job.status == JobStatus.FAILED else left, expected, having.lacks(job)
    )


def _queue_order(item: QueueItem) -> tuple[int, object]:
    order = (JobStatus.FAILED, JobStatus.RUNNING, JobStatus.QUEUED)
    return (order.index(JobStatus(item.job.status)), item.job.created_at)


def _seconds_per_frame(kind: str) -> float | None:
    """Return the average time per frame of the last finished jobs of that kind [s]; None if there are none."""
    completed = Job.objects.filter(
        kind=kind, status=JobStatus.DONE, claimed_at__isnull=False, finished_at__isnull=False
    )
    rows = list(
        completed.order_by("-finished_at").values_list("key", "claimed_at", "finished_at")[:_MEASURED]
    )
    uuids = [key.partition(":")[2] for key, _, _ in rows]
    frames = sum(Episode.objects.filter(pk__in=uuids).values_list("frames", flat=True))
    seconds = sum((finished - claimed).total_seconds() for _, claimed, finished in rows)
    return seconds / frames if frames else None
