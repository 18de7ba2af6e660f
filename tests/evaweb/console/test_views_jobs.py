"""The page of jobs: what it says, and what may be done there by whom."""

import pytest
from django.test import Client
from django.urls import reverse

from evaweb.blinding.visibility import HIDDEN, Visibility
from evaweb.console.views_jobs import KINDS, row_of
from evaweb.episodes.models import Episode
from evaweb.jobs import doorbell, kinds, services
from evaweb.jobs.models import Job
from evaweb.jobs.workers import served
from evaweb.stations.models import Station
from tests.evaweb.trials import builders

pytestmark = pytest.mark.django_db


@pytest.fixture
def page(monkeypatch):
    monkeypatch.setattr(doorbell, "notify_workers", lambda queue: True)
    browser = Client()
    browser.force_login(builders.user("ann"))
    return browser


@pytest.fixture
def episode():
    return Episode.objects.create(station=Station.objects.create(name="bench-1", robot="agilex_piper"))


def preview(episode, **facts):
    args = {"uuid": str(episode.uuid)}
    return Job.objects.create(kind="preview", key=f"preview:{episode.uuid}", args=args, **facts)


def test_all_kinds_have_words():
    assert set(kinds._kinds) - {"toy"} <= set(KINDS)


def test_an_empty_page_says_so(page):
    assert "Nothing to do" in page.get("/jobs/").content.decode()


def test_it_says_what_each_is_about_and_looks_again_while_something_runs(page, episode):
    preview(episode, status="running", progress="camera 2 of 3")
    text = page.get("/jobs/").content.decode()
    assert reverse("replay", args=[episode.uuid]) in text
    assert "camera 2 of 3" in text
    assert 'hx-trigger="every 2s"' in text
    Job.objects.update(status="failed", error="rows.arrow is damaged")
    text = page.get("/jobs/").content.decode()
    assert "rows.arrow is damaged" in text
    assert 'hx-trigger="every 2s"' not in text


def test_one_about_what_no_address_can_name_hides_no_other(page, episode):
    preview(episode, status="running", progress="camera 2 of 3")
    Job.objects.create(
        kind="dataset", key="dataset:1", args={"what": "merge", "datasets": ["a", "b"], "to": "a\nb"}
    )
    assert "camera 2 of 3" in page.get("/jobs/").content.decode()
    assert page.get("/").status_code == 200


def test_it_is_cancelled_and_repeated_there(page, episode):
    job = preview(episode)
    text = page.post("/jobs/cancel", {"job": job.pk, "query": "kind=preview"}, follow=True).content.decode()
    assert "cancelled by ann" in text
    assert "Kind: Preview" in text
    page.post("/jobs/repeat", {"job": job.pk})
    assert Job.objects.filter(status="queued").count() == 1
    assert (
        "there is nothing to cancel"
        in page.post("/jobs/cancel", {"job": job.pk}, follow=True).content.decode()
    )
    assert "job 0 does not exist" in page.post("/jobs/cancel", {"job": "x"}, follow=True).content.decode()


def test_a_program_cancels_too(page, episode):
    job = preview(episode)
    answer = page.post(reverse("api:job-cancel", args=[job.pk]))
    assert (answer.status_code, answer.json()["error"]) == (200, "cancelled by ann")
    assert page.post(reverse("api:job-cancel", args=[job.pk])).status_code == 409


def test_who_only_looks_is_offered_nothing(episode):
    job = preview(episode)
    visitor = Client()
    visitor.force_login(builders.user("visitor", "viewer"))
    assert "Cancel" not in visitor.get("/jobs/").content.decode()
    assert (
        "this needs an operator"
        in visitor.post("/jobs/cancel", {"job": job.pk}, follow=True).content.decode()
    )
    job.refresh_from_db()
    assert job.status == "queued"


def test_what_may_tell_which_checkpoint_it_is_about_is_hidden(episode):
    job = preview(episode, status="running", progress="asking the server of pi0-secret 2 of 3")
    row = row_of(job, Visibility(checkpoints=frozenset({1}), names=frozenset({"pi0-secret"})), served())
    assert (row.said, row.pace.fraction, row.minutes_left) == (HIDDEN, None, "")
    services.cancel(user=builders.user("ann"), job=job)
