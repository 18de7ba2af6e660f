"""Which jobs are listed, and how far one is."""

from datetime import timedelta

import pytest
from django.utils import timezone

from evaweb.jobs.models import Job, JobStatus
from evaweb.jobs.selectors import Pace, jobs_failed, jobs_listed, pace_of

pytestmark = pytest.mark.django_db
NOW = timezone.now()


def job(status="running", key="toy:1", took=10.0, **facts):
    return Job.objects.create(
        kind="toy", key=key, status=status, claimed_at=NOW - timedelta(seconds=took), **facts
    )


def test_what_failed_and_was_asked_for_again_is_found_by_an_index():
    """Each of thousands that failed is looked up among all jobs."""
    assert "jobs_job_key" in jobs_failed().explain()


def test_what_is_over_or_asked_for_again_is_not_listed():
    failed, again = job("failed"), job("queued")
    running, done, gone = job(key="toy:2"), job("done", key="toy:3"), job("failed", key="toy:4")
    assert list(jobs_listed()) == [running, again, gone]
    assert set(jobs_listed(status="failed")) == {failed, gone}
    assert list(jobs_listed(status="done", kind="toy")) == [done]
    assert list(jobs_listed(kind="other")) == []
    assert list(jobs_failed()) == [gone]


@pytest.mark.parametrize(
    ("progress", "pace"),
    [
        ("episode 3 of 10", Pace(0.2, 40.0)),
        ("cups: episode 1 of 10", Pace(0.0, None)),
        ("episode 11 of 10", Pace()),
        ("every file is compared", Pace()),
    ],
)
def test_what_is_left_goes_by_the_steps_and_the_rate_so_far(progress, pace):
    assert pace_of(job(progress=progress), NOW) == pace


def test_where_no_steps_are_told_it_goes_by_what_the_last_ones_took():
    for number, seconds in enumerate((30, 40, 90)):
        job(JobStatus.DONE, f"toy:1{number}", took=seconds, finished_at=NOW)
    assert pace_of(job(took=10), NOW) == Pace(0.25, 30.0)
    assert pace_of(job(key="toy:2", took=50), NOW) == Pace()  # longer than usual: nobody knows
    assert pace_of(job("queued", key="toy:3"), NOW) == Pace()
