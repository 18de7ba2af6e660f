"""Checks after an episode has closed, and what is said of it beside its dataset."""

import json
from datetime import timedelta

import pytest
from django.utils import timezone

from evaweb.episodes import services as episodes
from evaweb.episodes.models import Episode
from evaweb.jobs.models import Job
from evaweb.jobs.services import run_queue
from evaweb.reviews import job_kinds, services
from evaweb.reviews.models import Standing

pytestmark = pytest.mark.django_db


def job(kind):
    return Job.objects.get(kind=kind)


def test_an_episode_that_was_closed_is_checked_once(closed, data):
    episode = closed()
    assert job_kinds.find_unchecked_episodes() == 1
    assert job_kinds.find_unchecked_episodes() == 0
    run_queue("cpu")
    assert job("quality").error == ""
    report = json.loads((data / "quality" / f"{episode.uuid}.json").read_text())
    standing = Standing.objects.get(episode=episode)
    assert report["episode"] == str(episode.uuid)
    assert report["frames"] == episode.frames
    assert (standing.clean, standing.worst) == (report["clean"], report["worst"])
    assert standing.flags == sum(count["flags"] for count in report["counts"].values())
    assert standing.checked_at is not None


def test_other_bounds_of_the_lab_count(closed, data):
    episode = closed()
    (data / "quality.toml").write_text("min_length_s = 1000.0\n")
    services.request_quality_check(episode=episode)
    run_queue("cpu")
    report = json.loads((data / "quality" / f"{episode.uuid}.json").read_text())
    short = [flag for flag in report["flags"] if flag["kind"] == "too_short"]
    assert [flag["bound"] for flag in short] == [1000.0]
    (data / "quality.toml").write_text("min_length = 1000.0\n")
    services.request_quality_check(episode=episode)
    run_queue("cpu")
    assert "min_length" in Job.objects.filter(kind="quality").latest("pk").error


def test_an_episode_whose_tables_are_damaged_has_errors_and_the_job_is_done(closed, data):
    episode = closed()
    rows = data / "episodes" / str(episode.uuid) / "rows.arrow"
    rows.write_bytes(rows.read_bytes()[:200])
    services.request_quality_check(episode=episode)
    run_queue("cpu")
    assert job("quality").status == "done"
    assert Standing.objects.get(episode=episode).worst == "error"


def test_what_is_said_goes_beside_the_published_episode(closed, data, ann, bob):
    episode = closed()
    services.add_review(user=ann, episode=episode, verdict="pass")
    services.save_segment(user=bob, episode=episode, first=0, last=5, label="reach", milestone="touched")
    removed = services.save_segment(user=bob, episode=episode, first=6, last=9, label="wrong")
    services.remove_segment(user=bob, episode=episode, segment=removed.uuid)
    assert job_kinds.find_outdated_sidecars() == 0, "it is in no dataset yet"
    episodes.request_publish(episode=episode)
    run_queue("cpu")
    assert job_kinds.find_outdated_sidecars() == 1
    assert job_kinds.find_outdated_sidecars() == 0
    run_queue("cpu")
    assert job("sides").result == {"attached": True, "reviews": 1, "annotations": 1}
    dataset = data / Episode.objects.get().dataset
    (review,) = (dataset / "eva/reviews" / f"{episode.uuid}.jsonl").read_text().splitlines()
    (segment,) = (dataset / "eva/annotations" / f"{episode.uuid}.jsonl").read_text().splitlines()
    assert (json.loads(review)["verdict"], json.loads(review)["by"]) == ("pass", "ann")
    told = json.loads(segment)
    assert (told["first"], told["last"], told["label"], told["milestone"], told["by"]) == (
        0,
        5,
        "reach",
        "touched",
        "bob",
    )
    services.add_review(user=ann, episode=episode, verdict="fail")
    assert job_kinds.find_outdated_sidecars() == 1
    run_queue("cpu")
    assert len((dataset / "eva/reviews" / f"{episode.uuid}.jsonl").read_text().splitlines()) == 2


def test_a_review_is_published_however_far_ahead_the_clock_of_the_worker_is(closed, data, ann, monkeypatch):
    episode = closed()
    services.add_review(user=ann, episode=episode, verdict="pass")
    with monkeypatch.context() as ahead:
        hence = timezone.now() + timedelta(hours=1)
        ahead.setattr(timezone, "now", lambda: hence)
        episodes.request_publish(episode=episode)
        run_queue("cpu")
        assert job_kinds.find_outdated_sidecars() == 1
        run_queue("cpu")
    assert job_kinds.find_outdated_sidecars() == 0
    services.add_review(user=ann, episode=episode, verdict="fail")
    assert job_kinds.find_outdated_sidecars() == 1


def test_what_was_said_before_goes_into_the_dataset_with_the_episode_itself(closed, data, ann):
    episode = closed()
    services.add_review(user=ann, episode=episode, verdict="pass")
    services.save_segment(user=ann, episode=episode, first=1, last=4, label="reach")
    episodes.request_publish(episode=episode)
    run_queue("cpu")
    row = Episode.objects.get(uuid=episode.uuid)
    beside = {path.parent.name: path for path in (data / row.dataset / "eva").rglob(f"{episode.uuid}.jsonl")}
    (segment,) = [json.loads(line) for line in beside["annotations"].read_text().splitlines()]
    assert (segment["label"], segment["first"], segment["last"]) == ("reach", 1, 4)
    assert '"verdict": "pass"' in beside["reviews"].read_text()
