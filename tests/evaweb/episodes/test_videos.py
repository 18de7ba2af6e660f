"""Videos of Replay in a store: played by signed addresses or by us, read by judges, made anew where they are lost."""

from __future__ import annotations

import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest
from django.contrib.auth.models import User
from django.test import Client
from django.urls import reverse

from evaweb.core.object_stores import StoreError
from evaweb.episodes.folders import preview_folder, preview_video
from evaweb.episodes.job_kinds import store_at_start
from evaweb.episodes.models import Episode
from evaweb.episodes.selectors import playback_stage
from evaweb.episodes.videos import video_address, video_file
from evaweb.jobs.models import Job, JobStatus
from evaweb.jobs.services import run_queue
from evaweb.results.ratings.footage import trial_stills
from evaweb.serving.headers import content_security_policy
from tests.evaweb.s3_server import SECRET, Server, why_no_server

pytestmark = pytest.mark.django_db
CAMERA = "cam_high"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Any:
    if why := why_no_server():
        pytest.skip(why)
    made = Server(tmp_path_factory.mktemp("server"))
    yield made
    made.close()


@pytest.fixture
def stored(request: Any, closed: Callable[..., Episode], tmp_path: Path, settings: Any) -> Episode:
    """One whose videos are in the store; and what they were."""
    if request.param == "folder":
        settings.EVA_STORE = tmp_path / "store"
        settings.EVA_STORE.mkdir()
    else:
        settings.EVA_STORE = request.getfixturevalue("server").bucket(prefix=tmp_path.name)
    episode = closed()
    assert run_queue("cpu") == 2  # the preview, and what follows of it
    assert {(job.kind, job.status) for job in Job.objects.all()} == {("preview", "done"), ("store", "done")}
    return Episode.objects.get(pk=episode.pk)


@pytest.fixture
def person() -> User:
    return User.objects.create_user("ann", password="a password of tests")


both = pytest.mark.parametrize("stored", ["folder", "s3"], indirect=True)


@pytest.mark.some(1)
@both
def test_they_are_in_the_store_alone_and_can_be_played_and_judged(stored: Episode) -> None:
    assert list(preview_folder(stored.pk).glob("*.mp4")) == []
    assert playback_stage(episode=stored).name == "ready"
    assert video_file(stored.pk, CAMERA).stat().st_size > 0
    assert trial_stills(stored)


@pytest.mark.parametrize("stored", ["s3"], indirect=True)
def test_a_page_is_led_to_an_address_that_says_nothing_and_soon_ends(
    stored: Episode, client: Client, person: User
) -> None:
    client.force_login(person)
    answer = client.get(reverse("episode-video", args=[stored.pk, CAMERA]))
    assert answer.status_code == 302
    parts = urlsplit(answer["Location"])
    digest = parts.path.rpartition("/")[2]
    assert len(digest) == 64
    assert {name.partition("-")[0] for name in parse_qs(parts.query)} == {"X"}
    assert int(parse_qs(parts.query)["X-Amz-Expires"][0]) <= 300
    assert str(stored.pk) not in answer["Location"]
    assert SECRET not in answer["Location"]
    assert answer["Cache-Control"] == "no-store"


@pytest.mark.parametrize("stored", ["s3"], indirect=True)
def test_the_address_gives_the_video(stored: Episode) -> None:
    with urllib.request.urlopen(video_address(stored.pk, CAMERA)) as answer:
        assert answer.headers["Content-Type"] in (
            "video/mp4",
            "application/octet-stream",
        )  # as rclone keeps none
        assert answer.read() == video_file(stored.pk, CAMERA).read_bytes()


def test_a_store_that_is_away_leaves_them_here_until_a_worker_starts_and_it_is_back(
    previewed: Episode, tmp_path: Path, settings: Any
) -> None:
    settings.EVA_STORE = tmp_path / "store"
    settings.EVA_STORE.write_bytes(b"no folder")
    store_at_start()
    run_queue("cpu")
    job = Job.objects.get(kind="store")
    assert "does not take a file" in job.error
    assert preview_video(previewed.pk, CAMERA).is_file()
    Job.objects.filter(pk=job.pk).update(status=JobStatus.FAILED)
    settings.EVA_STORE.unlink()
    settings.EVA_STORE.mkdir()
    store_at_start()
    assert run_queue("cpu") == 1
    assert not preview_video(previewed.pk, CAMERA).exists()
    assert video_file(previewed.pk, CAMERA).is_file()


@pytest.mark.parametrize("stored", ["folder"], indirect=True)
def test_an_index_that_cannot_be_read_is_named(stored: Episode) -> None:
    for told in ("[1]", "{", '{"cam_high": 1}'):
        (preview_folder(stored.uuid) / "stored.json").write_text(told)
        with pytest.raises(StoreError, match=r"stored\.json does not say which videos are in the store"):
            video_file(stored.uuid, CAMERA)


@pytest.mark.exhaustive
def test_the_policy_of_pages_allows_the_store_and_nothing_else_that_is_new() -> None:
    plain, more = (content_security_policy(origin)["DIRECTIVES"] for origin in ("", "https://s3.example.org"))
    assert "media-src" not in plain
    assert more == plain | {"media-src": ["'self'", "https://s3.example.org"]}
