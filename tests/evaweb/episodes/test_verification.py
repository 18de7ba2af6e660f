"""Recordings are verified at leisure, round and round; what is damaged is shown, and never published."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path

import pytest
from django.contrib.auth.models import User
from django.test import Client
from django.utils import timezone

from evaweb.core.errors import Conflict
from evaweb.datasets.robot_replay import playable_episode
from evaweb.episodes import selectors, services, verification
from evaweb.episodes.job_kinds import find_unverified_episodes
from evaweb.episodes.models import Episode
from evaweb.episodes.reconcile import reconcile
from evaweb.jobs import services as jobs
from evaweb.jobs.models import Job, JobStatus
from runtime.recording.integrity import UNSEALED
from runtime.recording.quarantine import marked_damage
from runtime.recording.repair import repair
from tests.runtime.recording.samples import unended, unsealed

pytestmark = pytest.mark.django_db

Closed = Callable[..., Episode]


@pytest.fixture
def old(closed: Closed) -> Episode:
    """An episode of a week ago, whose worker has nothing else to do."""
    episode = closed()
    jobs.run_queue("cpu")
    Episode.objects.update(created_at=timezone.now() - timedelta(days=7))
    episode.refresh_from_db()
    return episode


@contextmanager
def a_bit_off(path: Path) -> Iterator[None]:
    whole = path.read_bytes()
    content = bytearray(whole)
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    yield
    path.write_bytes(whole)


def scrubbed() -> Job:
    """The worker's next look, and what it then does."""
    assert find_unverified_episodes()
    jobs.run_queue("cpu")
    return Job.objects.filter(kind="scrub").latest("created_at")


def folder_of(data: Path, episode: Episode) -> Path:
    return data / "episodes" / str(episode.uuid)


def test_an_old_recording_is_verified_once_and_again_after_a_month(old: Episode) -> None:
    job = scrubbed()
    assert job.status == JobStatus.DONE
    assert (job.result["sound"], job.result["found"], job.result["problems"]) == (1, [], [])
    assert job.result["bytes"] > 1000
    assert not find_unverified_episodes()
    Episode.objects.update(verified_at=timezone.now() - verification.AGAIN_AFTER - timedelta(hours=1))
    assert scrubbed().pk != job.pk
    old.refresh_from_db()
    assert (old.damage, old.verified_at is not None) == ([], True)


def test_what_was_just_recorded_waits_and_so_does_a_scrub_while_anything_else_is_asked_for(
    closed: Closed,
) -> None:
    episode = closed()
    assert Job.objects.filter(status=JobStatus.QUEUED).exists()  # its preview
    Episode.objects.update(created_at=timezone.now() - timedelta(days=7))
    assert not find_unverified_episodes()
    jobs.run_queue("cpu")
    Episode.objects.update(created_at=timezone.now())
    assert not find_unverified_episodes()
    Episode.objects.filter(pk=episode.pk).update(created_at=timezone.now() - timedelta(days=7))
    assert find_unverified_episodes()


def test_a_scrub_goes_round_a_bounded_part_at_a_time(
    old: Episode, put: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = put("interrupted")
    services.sync_episode(uuid=folder.name)
    jobs.run_queue("cpu")
    Episode.objects.update(created_at=timezone.now() - timedelta(days=7))
    monkeypatch.setattr(verification, "MOST_BYTES", 1)
    assert scrubbed().result["sound"] == 1
    assert Episode.objects.filter(verified_at=None).count() == 1
    assert scrubbed().result["sound"] == 1
    assert not Episode.objects.filter(verified_at=None).exists()
    assert not find_unverified_episodes()


def test_damage_is_kept_on_the_disk_and_shown_until_the_files_are_back(
    old: Episode, data: Path, client: Client, vera: User
) -> None:
    client.force_login(vera)
    with a_bit_off(folder_of(data, old) / "ticks.arrow"):
        job = scrubbed()
        assert (job.status, job.result["damaged"]) == (JobStatus.DONE, 1)
        (found,) = job.result["found"]
        assert found["uuid"] == str(old.uuid)
        assert "ticks.arrow is changed, rows " in found["why"]
        old.refresh_from_db()
        assert old.damage == marked_damage(data, str(old.uuid))
        assert list(selectors.episode_list(quality="damaged")) == [old]
        assert "ticks.arrow is changed" in client.get(f"/replay/{old.uuid}/").content.decode()
        assert "ticks.arrow is changed" in client.get("/replay/?quality=damaged").content.decode()
        Episode.objects.all().delete()  # the database is an index
        reconcile()
        old = Episode.objects.get(pk=old.pk)
        assert [damage["file"] for damage in old.damage] == ["ticks.arrow"]
        with pytest.raises(Conflict, match=r"is damaged: ticks\.arrow is changed"):
            playable_episode(str(old.uuid))
        jobs.run_queue("cpu")
    Episode.objects.update(verified_at=None, created_at=timezone.now() - timedelta(days=7))
    assert scrubbed().result["sound"] == 1
    old.refresh_from_db()
    assert (old.damage, marked_damage(data, str(old.uuid))) == ([], [])
    assert not selectors.episode_list(quality="damaged").exists()
    assert playable_episode(str(old.uuid)).rows == old.frames


@pytest.mark.some(2)
@pytest.mark.parametrize(
    "name", ["rows.arrow", "raw.arrow", "smoothed.arrow", "events.jsonl", "cam_high.mp4"]
)
def test_a_publication_finds_the_damage_itself_and_keeps_it(old: Episode, data: Path, name: str) -> None:
    with a_bit_off(folder_of(data, old) / name):
        job = services.request_publish(episode=old)
        jobs.run_queue("cpu")
        job.refresh_from_db()
    assert (job.status, job.attempts, job.result["published"]) == (JobStatus.DONE, 0, False)
    assert f"is damaged: {name} is " in job.result["why"]
    old.refresh_from_db()
    assert ([damage["file"] for damage in old.damage], old.dataset_index) == ([name], None)
    assert not (data / "datasets").exists()


def test_figures_of_damaged_rows_are_not_measured(old: Episode, data: Path) -> None:
    Episode.objects.update(smoothness=None, smoothness_detail=None)
    with a_bit_off(folder_of(data, old) / "rows.arrow"):
        assert services.request_smoothness(most=1) == 1
        jobs.run_queue("cpu")
    old.refresh_from_db()
    assert old.smoothness is None
    assert "rows.arrow is changed" in old.smoothness_detail["why"]


def test_an_older_recording_is_published_and_said_to_have_no_digests(old: Episode, data: Path) -> None:
    unsealed(folder_of(data, old))
    Episode.objects.update(seal="")
    assert scrubbed().result["unsealed"] == 1
    job = services.request_publish(episode=old)
    jobs.run_queue("cpu")
    job.refresh_from_db()
    assert (job.result["published"], job.result["remark"]) == (True, UNSEALED)


def test_a_recording_that_is_gone_keeps_none_of_the_others(old: Episode, data: Path) -> None:
    folder_of(data, old).rename(data / "elsewhere")
    job = scrubbed()
    assert (job.status, job.result["sound"]) == (JobStatus.DONE, 0)
    assert "is no episode" in job.result["problems"][0]
    assert not find_unverified_episodes()


# --- an outcome that is lost ---------------------------------------------------------------------------------


def again() -> Job:
    """The next look, a month later."""
    jobs.run_queue("cpu")
    Episode.objects.update(verified_at=None, created_at=timezone.now() - timedelta(days=7))
    return scrubbed()


def test_a_closed_recording_that_lost_its_outcome_is_damaged_until_it_is_back(
    old: Episode, data: Path
) -> None:
    folder = folder_of(data, old)
    (folder / "outcome.json").unlink()
    (problem,) = reconcile().problems
    assert "outcome.json is absent, though the recording was closed as finished" in problem
    for _ in range(2):
        job = again()
        assert (job.result["damaged"], job.result["open"]) == (1, 0)
        assert "outcome.json is absent, though" in job.result["found"][0]["why"]
        old.refresh_from_db()
        assert (old.status, old.damage) == ("finished", marked_damage(data, str(old.uuid)))
    assert repair(folder).verdict == "restored"
    assert again().result["sound"] == 1
    old.refresh_from_db()
    assert (old.damage, marked_damage(data, str(old.uuid))) == ([], [])


def test_one_that_lost_both_is_marked_and_then_not_sealed_by_repair(old: Episode, data: Path) -> None:
    folder = folder_of(data, old)
    unended(folder)
    assert again().result["damaged"] == 1
    assert repair(folder).verdict == "damaged"
    assert not (folder / "outcome.json").exists()
    old.refresh_from_db()
    assert old.damage


def test_one_that_was_sealed_anew_before_anybody_looked_is_damaged_and_not_published(
    old: Episode, data: Path
) -> None:
    folder = folder_of(data, old)
    aside = {name: (folder / name).read_bytes() for name in ("outcome.json", "sealed.json", "rows.arrow")}
    unended(folder)
    shutil.rmtree(data / "exports")
    (folder / "rows.arrow").write_bytes(aside["rows.arrow"][:-20])
    assert repair(folder).verdict == "repaired"
    publication = services.request_publish(episode=old)
    jobs.run_queue("cpu")
    publication.refresh_from_db()
    said = "outcome.json is not the one with which the recording was closed"
    assert publication.result["published"] is False
    assert said in publication.result["why"]
    (problem,) = reconcile().problems
    assert said in problem
    assert said in again().result["found"][0]["why"]
    old.refresh_from_db()
    assert (old.status, [one["file"] for one in old.damage]) == ("finished", ["outcome.json"])
    for name, content in aside.items():
        (folder / name).write_bytes(content)
    assert again().result["sound"] == 1
    assert reconcile().problems == ()
    assert marked_damage(data, str(old.uuid)) == []


def test_a_folder_with_nothing_by_which_it_is_an_episode_is_damaged(old: Episode, data: Path) -> None:
    unended(folder_of(data, old))
    (folder_of(data, old) / "manifest.json").unlink()
    assert again().result["damaged"] == 1
    assert [one["file"] for one in marked_damage(data, str(old.uuid))] == ["manifest.json", "outcome.json"]
