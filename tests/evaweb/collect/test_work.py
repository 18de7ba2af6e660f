"""The queue of a session: the newest job of each kind about its episodes, how long it takes, what has failed."""

from __future__ import annotations

from datetime import timedelta

import pytest
from django.utils import timezone

from evaweb.collect.models import CollectSession, Demonstration
from evaweb.collect.work import session_queue
from evaweb.jobs.models import Job
from tests.evaweb.collect.conftest import Demonstrate

pytestmark = pytest.mark.django_db


def job(of: Demonstration, kind: str, status: str, seconds: float | None = None, **more: object) -> Job:
    """One that has taken, or has run for, so long."""
    now = timezone.now()
    if seconds is not None:
        more |= {"claimed_at": now - timedelta(seconds=seconds)}
        more |= {"finished_at": now} if status == "done" else {}
    return Job.objects.create(kind=kind, key=f"{kind}:{of.pk}", status=status, **more)


@pytest.fixture
def two(demonstrate: Demonstrate) -> tuple[Demonstration, Demonstration]:
    """24 frames each, and no job."""
    made = (demonstrate(), demonstrate())
    Job.objects.all().delete()
    return made


def test_nothing_to_do_is_an_empty_queue(session: CollectSession, two: tuple) -> None:
    found = session_queue(session=session)
    assert (found.items, found.total, found.done, found.active, found.left_s) == ((), 0, 0, False, 0)


def test_time_left_is_that_of_earlier_jobs_of_the_kind_frame_by_frame(
    session: CollectSession, two: tuple
) -> None:
    first, second = two
    job(first, "quality", "done", 8.0)
    job(first, "preview", "done", 4.0)
    job(second, "quality", "running", 2.0)
    job(second, "preview", "queued")
    found = session_queue(session=session)
    assert [(item.job.kind, item.number) for item in found.items] == [("quality", 2), ("preview", 2)]
    assert [item.left_s for item in found.items] == pytest.approx([6.0, 4.0], abs=0.5)
    assert found.items[0].fraction == pytest.approx(0.25, abs=0.1)
    assert found.left_s == pytest.approx(10.0, abs=0.5)
    assert (found.done, found.total, found.active, found.failed) == (2, 4, True, 0)


def test_a_kind_that_was_never_done_has_no_known_time(session: CollectSession, two: tuple) -> None:
    job(two[0], "publish", "queued")
    found = session_queue(session=session)
    assert (found.items[0].left_s, found.left_s) == (None, None)


def test_the_newest_of_a_key_counts_and_failures_stand_first(session: CollectSession, two: tuple) -> None:
    first, second = two
    job(first, "preview", "failed", error="no space")
    job(first, "preview", "done", 1.0)
    job(first, "quality", "queued")
    job(second, "publish", "failed", error="discarded")
    found = session_queue(session=session)
    assert [(item.job.kind, item.job.status) for item in found.items] == [
        ("publish", "failed"),
        ("quality", "queued"),
    ]
    assert (found.failed, found.done) == (1, 1)


def test_jobs_of_others_are_not_in_it(session: CollectSession, two: tuple) -> None:
    Job.objects.create(kind="preview", key="preview:00000000-0000-4000-8000-000000000009")
    Job.objects.create(kind="reconcile", key="reconcile")
    assert session_queue(session=session).total == 0
