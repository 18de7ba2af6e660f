"""Jobs of blind trials: that there are some, and no more; other jobs are shown as they are."""

import pytest
from django.test import Client
from django.urls import reverse

from evaweb.blinding.visibility import HIDDEN
from evaweb.episodes.models import Episode
from evaweb.jobs.models import Job
from evaweb.plans.allocation import allocate_trial
from evaweb.plans.models import Plan
from evaweb.plans.services import close_plan, freeze_plan, reveal_plan
from tests.evaweb.trials import builders


def job(episode, **facts):
    uuid = str(episode.uuid)
    return Job.objects.create(kind="preview", key=f"preview:{uuid}", args={"uuid": uuid}, **facts)


@pytest.fixture
def boss(db):
    return builders.user("boss", "admin")


@pytest.fixture
def jobs(bench, draft, owner):
    """A failed one of a blind trial, a failed one of a run in Debug, and one of the whole disk."""
    plan = freeze_plan(user=owner, plan=draft)
    trial = builders.finished_trial(
        allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
    )
    recorded = trial.episode
    other = Episode.objects.create(station=bench.station, status="finished", mode="async", frames=9)
    failed = {"status": "failed", "error": "ws://secret is away"}
    return (
        job(recorded, **failed),
        job(other, status="failed", error="no space left"),
        Job.objects.create(kind="reconcile", key="reconcile", status="failed", error="pi0-new is away"),
    )


def rows(user):
    browser = Client()
    browser.force_login(user)
    listed = {row["id"]: row for row in browser.get(reverse("api:jobs")).json()["items"]}
    page = browser.get("/jobs/").content.decode()
    file = b"".join(browser.get("/jobs/?format=csv").streaming_content).decode()
    return listed, page, file


def test_of_a_blind_trial_neither_key_nor_times_nor_words_are_shown(jobs, bench, boss, owner):
    blind, other, disk = jobs
    listed, page, file = rows(boss)
    assert listed[blind.pk]["key"] == listed[blind.pk]["error"] == HIDDEN
    assert [listed[blind.pk][name] for name in ("created_at", "claimed_at", "finished_at")] == [None] * 3
    assert (listed[other.pk]["key"], listed[other.pk]["error"]) == (other.key, "no space left")
    assert listed[disk.pk]["error"] == HIDDEN
    assert "a blind trial" in page
    assert "no space left" in page
    for text in (page, file):
        assert (blind.args["uuid"][:8] in text, other.args["uuid"][:8] in text) == (False, True)
        assert "secret" not in text
    plan = Plan.objects.get()
    bench_trial = plan.handouts.get().trial
    bench_trial.status = "voided"
    bench_trial.save()
    close_plan(user=owner, plan=plan, reason="enough")
    reveal_plan(user=owner, plan=plan)
    listed, page, _ = rows(boss)
    assert (listed[blind.pk]["error"], listed[blind.pk]["key"]) == ("ws://secret is away", blind.key)
    assert "ws://secret is away" in page


def test_whoever_has_acted_on_one_sees_no_more_of_it(jobs, bench):
    blind = jobs[0]
    browser = Client()
    browser.force_login(bench.operator)
    answer = browser.post(reverse("api:job-retry", args=[blind.pk]))
    assert (answer.status_code, answer.json()["key"]) == (202, HIDDEN)
