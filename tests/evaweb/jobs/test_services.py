"""Jobs from being asked for to their end: one at a time, once, and nothing lost."""

from __future__ import annotations

from datetime import timedelta
from uuid import uuid4

import pytest
from django.contrib.auth.models import User
from django.db import OperationalError
from django.db.models.functions import Now
from django.utils import timezone

from evaweb.core import lock_wait
from evaweb.core.errors import Conflict, NotAllowed
from evaweb.jobs import locks, services
from evaweb.jobs.kinds import JobContext, JobUnfinished, UnknownKind
from evaweb.jobs.locks import exclusive_job
from evaweb.jobs.models import Job, JobStatus
from tests.evaweb.conftest import person
from tests.evaweb.jobs.conftest import Toy
from tests.evaweb.trials import builders

pytestmark = [pytest.mark.django_db, pytest.mark.usefixtures("rung")]


def enqueue(**args: object) -> Job:
    return services.enqueue(kind="toy", key="toy:1", args=args)


def silent(job: Job, seconds: float = 120.0) -> None:
    """Make the job look as if its worker had last been seen so long ago."""
    Job.objects.filter(pk=job.pk).update(seen_at=Now() - timedelta(seconds=seconds))


def due(job: Job) -> None:
    Job.objects.filter(pk=job.pk).update(not_before=None)


def claim() -> Job:
    """The oldest job, as a worker gets it that never says anything again."""
    claimed = services.claim(queue="cpu", owner=uuid4())
    assert claimed is not None
    return claimed


def break_down(work: JobContext) -> dict[str, object]:
    raise ValueError("rows.arrow is damaged")


def test_a_job_is_done_and_keeps_its_result(toy: Toy) -> None:
    job = enqueue(a=1)
    assert services.run_queue("cpu") == 1
    job.refresh_from_db()
    assert (job.status, job.result, job.attempts) == (JobStatus.DONE, {"seen": {"a": 1}}, 0)
    assert job.finished_at is not None
    assert services.run_queue("cpu") == 0


@pytest.mark.django_db(transaction=True)
def test_the_doorbell_rings_when_the_row_can_be_seen(toy: Toy, rung: list[str]) -> None:
    services.enqueue(kind="toy", key="k", args={})
    assert rung == ["cpu"]


def test_the_same_key_twice_is_one_job_with_the_newest_args(toy: Toy) -> None:
    assert enqueue(a=1).pk == enqueue(a=2).pk
    services.run_queue("cpu")
    assert toy.asked == [{"a": 2}]


def test_what_is_asked_for_while_the_same_is_being_done_is_done_once_more_afterwards(toy: Toy) -> None:
    enqueue(a=1)

    def ask_again(work: JobContext) -> dict[str, object]:
        if work.args["a"] == 1:
            enqueue(a=2)
            assert services.claim(queue="cpu", owner=uuid4()) is None, "two of one key at once"
        return {}

    toy.does = ask_again
    assert services.run_queue("cpu") == 2
    assert toy.asked == [{"a": 1}, {"a": 2}]


def test_of_two_workers_one_gets_the_job(toy: Toy) -> None:
    enqueue()
    claim()
    assert services.claim(queue="cpu", owner=uuid4()) is None


def test_another_queue_is_left_alone(toy: Toy) -> None:
    enqueue()
    assert services.run_queue("gpu") == 0


def test_a_kind_that_nobody_knows_is_refused_when_it_is_asked_for(toy: Toy) -> None:
    with pytest.raises(UnknownKind, match=r"no job of kind .paint. is known; there are .*toy"):
        services.enqueue(kind="paint", key="p", args={})


def test_an_error_is_kept_and_tried_again_later_until_the_last_attempt(toy: Toy) -> None:
    toy.does = break_down
    job = enqueue()
    for attempt in range(1, services.MOST_ATTEMPTS):
        assert services.run_queue("cpu") == 1
        job.refresh_from_db()
        assert (job.status, job.attempts) == (JobStatus.QUEUED, attempt)
        assert job.error == "rows.arrow is damaged"
        assert services.run_queue("cpu") == 0, "it waits before it is tried again"
        due(job)
    services.run_queue("cpu")
    job.refresh_from_db()
    assert (job.status, job.error) == (JobStatus.FAILED, "rows.arrow is damaged")
    toy.does = lambda work: {}
    services.retry_job(user=person("olga", "operator"), job=job)
    assert services.run_queue("cpu") == 1


def test_an_unfinished_job_is_queued_again_behind_those_that_wait_and_not_if_it_is_cancelled(
    toy: Toy,
) -> None:
    def part(work: JobContext) -> dict[str, object]:
        if len(toy.asked) < 4:
            raise JobUnfinished
        return {}

    toy.does = part
    job = enqueue()
    other = services.enqueue(kind="toy", key="toy:2", args={"other": True})
    Job.objects.filter(pk=job.pk).update(attempts=2, deaths=3, error="before")
    assert services.run_queue("cpu") == 5
    assert [bool(asked) for asked in toy.asked] == [False, True, False, True, False]
    job.refresh_from_db()
    assert (job.status, job.attempts, job.deaths, job.error) == (JobStatus.DONE, 0, 0, "")

    def part_and_cancelled(work: JobContext) -> dict[str, object]:
        services.cancel(user=person("olga", "operator"), job=again)
        raise JobUnfinished(60.0)

    toy.does = part_and_cancelled
    again = enqueue()
    services.run_queue("cpu")
    again.refresh_from_db()
    assert (again.status, again.error) == (JobStatus.FAILED, "cancelled by olga")
    assert other.pk


def test_a_silent_worker_is_swept_and_its_job_done_once_by_another(toy: Toy) -> None:
    job = enqueue()
    silenced = claim()
    assert services.reclaim_stale_jobs() == 0, "it was seen just now"
    silent(job)
    assert services.reclaim_stale_jobs() == 1
    assert services.reclaim_stale_jobs() == 0
    assert services.run_queue("cpu") == 1
    job.refresh_from_db()
    assert (job.status, job.attempts, job.deaths) == (JobStatus.DONE, 0, 1)
    assert services.job_done(job=silenced, result={"late": True}) is False
    job.refresh_from_db()
    assert job.result == {"seen": {}}, "who was thought dead must not change what the other one found"


@pytest.mark.parametrize("seconds", [-86400.0, 61.0, 86400.0])
def test_the_clocks_of_workers_decide_nothing(
    toy: Toy, monkeypatch: pytest.MonkeyPatch, seconds: float
) -> None:
    toy.does = break_down
    enqueue()
    services.run_queue("cpu")
    now = timezone.now()
    off = now + timedelta(seconds=seconds)
    monkeypatch.setattr(timezone, "now", lambda: off)
    assert services.claim(queue="cpu", owner=uuid4()) is None, "it waits before it is tried again"
    Job.objects.update(not_before=None)
    job = claim()
    assert services.reclaim_stale_jobs() == 0, "it was seen just now"
    assert abs(job.seen_at - now) < timedelta(seconds=30)
    assert services.heartbeat(job=job)
    assert services.job_done(job=job, result={})
    job.refresh_from_db()
    assert job.finished_at - job.created_at < timedelta(seconds=30)


def test_a_worker_that_has_ended_is_not_waited_for_where_that_is_certain(toy: Toy) -> None:
    job = enqueue()
    claimed = claim()
    with exclusive_job(job.key, claimed.owner):
        silent(job)
        assert services.reclaim_stale_jobs() == 0, "it is at work, whatever its signs of life"
        left = locks._path(job.key).read_bytes()
    Job.objects.update(seen_at=Now())
    assert services.reclaim_stale_jobs() == 0, "it has let go: its signs of life tell"
    locks._path(job.key).write_bytes(left.replace(str(claimed.owner).encode(), str(uuid4()).encode()))
    assert services.reclaim_stale_jobs() == 0, "the lock is one that somebody else has left"
    locks._path(job.key).write_bytes(left[:36] + b" another kernel")
    assert services.reclaim_stale_jobs() == 0, "locks of another machine may not reach here"
    locks._path(job.key).write_bytes(left)
    assert services.reclaim_stale_jobs() == 1
    assert services.run_queue("cpu") == 1
    job.refresh_from_db()
    assert (job.status, job.attempts, job.deaths) == (JobStatus.DONE, 0, 1)
    assert not locks._path(job.key).exists()


def test_two_of_one_key_are_never_at_work_on_one_disk(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locks, "_AGAIN_S", 0.0)
    job = enqueue()
    with exclusive_job(job.key, uuid4()):
        assert services.run_queue("cpu") == 1
    assert toy.asked == []
    job.refresh_from_db()
    assert (job.status, job.attempts, job.deaths) == (JobStatus.QUEUED, 0, 0)
    assert "the worker that had it before is still at it" in job.progress
    due(job)
    assert services.run_queue("cpu") == 1
    assert len(toy.asked) == 1


def test_a_worker_whose_job_was_taken_goes_no_further_with_it(toy: Toy) -> None:
    job = enqueue()
    written = []

    def tell(work: JobContext) -> dict[str, object]:
        Job.objects.filter(pk=job.pk).update(owner=other)
        work.report_progress("camera 1 of 3")
        written.append("camera 2")
        return {}

    other = uuid4()
    toy.does = tell
    services.run_queue("cpu")
    job.refresh_from_db()
    assert (job.status, job.owner, job.attempts, job.progress) == (JobStatus.RUNNING, other, 0, "")
    assert written == []


def test_a_job_that_ends_every_worker_fails_in_the_end_and_lets_others_have_their_turn(toy: Toy) -> None:
    job = enqueue()
    for death in range(services.MOST_DEATHS):
        due(job)
        dead = claim()
        silent(job)
        assert services.reclaim_stale_jobs() == 1
        assert death == 0 or services.claim(queue="cpu", owner=uuid4()) is None, "it waits for its next turn"
    job.refresh_from_db()
    assert (job.status, job.attempts) == (JobStatus.FAILED, 0)
    assert job.error == (
        f"its worker {dead.owner} ended or went silent, which is number 8 of 8: "
        "the worker's log says what ended them; then try it again"
    )
    services.retry_job(user=person("olga", "operator"), job=job)
    assert services.run_queue("cpu") == 1


def test_deaths_of_workers_use_up_no_attempts(toy: Toy) -> None:
    toy.does = break_down
    job = enqueue()
    for errors in range(1, services.MOST_ATTEMPTS + 1):
        due(job)
        claim()
        silent(job)
        services.reclaim_stale_jobs()
        due(job)
        services.run_queue("cpu")
        job.refresh_from_db()
        assert (job.attempts, job.deaths) == (errors, errors)
    assert job.status == JobStatus.FAILED


def test_a_stale_job_gives_way_to_one_that_was_asked_for_anew(toy: Toy) -> None:
    old = enqueue(a=1)
    claim()
    silent(old)
    new = enqueue(a=2)
    assert services.reclaim_stale_jobs() == 1
    old.refresh_from_db()
    assert old.status == JobStatus.FAILED
    assert services.run_queue("cpu") == 1
    new.refresh_from_db()
    assert new.status == JobStatus.DONE


def test_a_sign_of_life_is_one_only_from_who_has_the_job(toy: Toy) -> None:
    job = enqueue()
    claimed = claim()
    silent(job)
    assert services.heartbeat(job=claimed) is True
    assert services.reclaim_stale_jobs() == 0
    claimed.owner = uuid4()
    assert services.heartbeat(job=claimed) is False


def test_what_an_ending_worker_puts_back_is_neither_an_error_nor_a_death(toy: Toy) -> None:
    job = enqueue()
    claimed = claim()
    assert services.requeue(owner=uuid4()) == 0
    assert services.requeue(owner=claimed.owner) == 1
    job.refresh_from_db()
    assert (job.status, job.attempts, job.deaths) == (JobStatus.QUEUED, 0, 0)
    assert services.run_queue("cpu") == 1


def test_progress_is_shown_while_it_works_and_gone_afterwards(toy: Toy) -> None:
    job = enqueue()

    def tell(work: JobContext) -> dict[str, object]:
        work.report_progress("camera 1 of 3")
        job.refresh_from_db()
        assert (job.status, job.progress) == (JobStatus.RUNNING, "camera 1 of 3")
        return {}

    toy.does = tell
    services.run_queue("cpu")
    job.refresh_from_db()
    assert (job.status, job.progress) == (JobStatus.DONE, "")


@pytest.mark.django_db(transaction=True)
def test_a_locked_database_is_waited_for_before_a_job_and_after_it(
    toy: Toy, monkeypatch: pytest.MonkeyPatch
) -> None:
    waited: list[float] = []
    monkeypatch.setattr(lock_wait.time, "sleep", waited.append)
    for name in ("claim", "job_done"):
        monkeypatch.setattr(services, name, locked_twice(getattr(services, name)))
    job = enqueue()
    assert services.run_queue("cpu") == 1
    job.refresh_from_db()
    assert job.status == JobStatus.DONE
    assert len(toy.asked) == 1
    assert waited == [*lock_wait.WAITS_S[:2], *lock_wait.WAITS_S[:2]]


def locked_twice(action):
    left = [2]

    def attempt(**given):
        if left[0]:
            left[0] -= 1
            raise OperationalError("database is locked")
        return action(**given)

    return attempt


@pytest.mark.django_db(transaction=True)
def test_a_database_that_stays_away_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lock_wait.time, "sleep", lambda seconds: None)
    attempts = []

    def away() -> None:
        attempts.append(1)
        raise OperationalError("database is locked")

    with pytest.raises(OperationalError, match="locked"):
        lock_wait.retry_while_locked(away)
    assert len(attempts) == len(lock_wait.WAITS_S) + 1


# --- cancelled -----------------------------------------------------------------------------------------------


@pytest.fixture
def ann() -> User:
    return builders.user("ann")


def test_a_job_that_waits_is_cancelled_at_once(toy: Toy, ann: User) -> None:
    job = services.cancel(user=ann, job=enqueue())
    assert (job.status, job.error, job.cancelled_by) == (JobStatus.FAILED, "cancelled by ann", ann)
    assert services.run_queue("cpu") == 0
    assert toy.asked == []


def test_a_job_that_runs_ends_at_its_next_step_and_can_be_repeated(toy: Toy, ann: User) -> None:
    steps = []

    def walk(work: JobContext) -> dict[str, object]:
        for step in range(3):
            steps.append(step)
            if step == 1:
                services.cancel(user=ann, job=Job.objects.get())
            work.report_progress(f"step {step + 1} of 3")
        return {}

    toy.does = walk
    job = enqueue()
    services.run_queue("cpu")
    job.refresh_from_db()
    assert steps == [0, 1]
    assert (job.status, job.error, job.attempts) == (JobStatus.FAILED, "cancelled by ann", 0)
    toy.does = lambda work: {}
    services.retry_job(user=person("olga", "operator"), job=job)
    assert services.run_queue("cpu") == 1


def test_what_is_cancelled_is_not_tried_again_after_an_error_or_a_death(toy: Toy, ann: User) -> None:
    def cancelled(work: JobContext) -> dict[str, object]:
        services.cancel(user=ann, job=Job.objects.get())
        raise ValueError("rows.arrow is damaged")

    toy.does = cancelled
    job = enqueue()
    services.run_queue("cpu")
    job.refresh_from_db()
    assert (job.status, job.error) == (JobStatus.FAILED, "cancelled by ann")
    other = services.enqueue(kind="toy", key="toy:2", args={})
    services.cancel(user=ann, job=claim())
    silent(other)
    services.reclaim_stale_jobs()
    other.refresh_from_db()
    assert (other.status, other.error) == (JobStatus.FAILED, "cancelled by ann")


def test_what_was_done_before_its_next_step_is_done(toy: Toy, ann: User) -> None:
    toy.does = lambda work: {"by": services.cancel(user=ann, job=Job.objects.get()).pk}
    job = enqueue()
    services.run_queue("cpu")
    job.refresh_from_db()
    assert job.status == JobStatus.DONE
    with pytest.raises(Conflict, match="nothing to cancel"):
        services.cancel(user=ann, job=job)


def test_who_only_looks_cancels_nothing(toy: Toy) -> None:
    with pytest.raises(NotAllowed):
        services.cancel(user=builders.user("visitor", "viewer"), job=enqueue())
