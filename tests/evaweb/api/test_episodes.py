"""Episodes over REST: their mode, how the policy did, and their table."""

import uuid
from pathlib import Path

import pytest
from asgiref.sync import async_to_sync
from django.test import AsyncClient

from evaweb.episodes import services, verification
from evaweb.episodes.models import Episode
from evaweb.jobs import doorbell
from evaweb.jobs.models import Job
from evaweb.jobs.services import run_queue
from runtime.recording.scrub import verify_episode
from tests.runtime.recording.test_export import recorded


@pytest.fixture
def episode(bench, tmp_path, monkeypatch):
    monkeypatch.setattr(doorbell, "notify_workers", lambda queue: True)
    folder = recorded(tmp_path, station=bench.station.name, mode="step")
    found = services.record_closed(station=bench.station, data={"uuid": folder.name})
    Job.objects.all().delete()
    return found


def download(rest, episode):
    """The answer and all its pieces, over ASGI as daphne asks."""

    async def ask():
        address = f"/api/v1/episodes/{episode.uuid}/export"
        answer = await AsyncClient().get(address, headers=rest._headers())
        return answer, b"".join([piece async for piece in answer.streaming_content])

    return async_to_sync(ask)()


@pytest.mark.django_db
def test_mode_strategy_and_figures_of_the_policy_are_told(rest, episode):
    _, found = rest.get(f"episodes/{episode.uuid}")
    assert (found["mode"], found["strategy"], found["policy"]) == ("step", "async", {"answers": 2})
    assert rest.get("episodes", mode="step")[1]["total"] == 1
    assert rest.get("episodes", mode="sim")[1]["total"] == 0
    status, refused = rest.get("episodes", mode="fast")
    assert status == 422
    assert "mode = 'fast'" in refused["error"]


@pytest.mark.django_db
def test_damage_is_told_with_its_rows_and_can_be_asked_for(rest, episode, tmp_path):
    assert rest.get("episodes", damaged=True)[1]["total"] == 0
    path = tmp_path / f"episodes/{episode.uuid}/ticks.arrow"
    path.write_bytes(path.read_bytes()[:-100])
    verification.record_verification(verify_episode(path.parent))
    _, found = rest.get("episodes", damaged=True)
    (damage,) = found["items"][0]["damage"]
    assert (damage["file"], damage["text"][:16]) == ("ticks.arrow", "ticks.arrow has ")
    assert damage["rows"]
    assert found["items"][0]["verified_at"]
    assert rest.get("episodes", damaged=False)[1]["total"] == 0


@pytest.mark.django_db
def test_a_table_is_asked_for_made_and_downloaded(rest, viewer, episode):
    path = f"episodes/{episode.uuid}/export"
    status, missing = rest.get(path)
    assert status == 404
    assert "is not made yet: POST to this address has it made" in missing["error"]
    assert viewer.post(path)[0] == 403
    status, job = rest.post(path)
    assert (status, job["kind"], job["status"]) == (202, "export", "queued")
    assert run_queue("cpu") == 1
    answer, content = download(viewer, episode)
    assert answer["Content-Type"] == "application/vnd.apache.parquet"
    assert answer["Content-Disposition"].startswith("attachment")
    assert content[:4] == content[-4:] == b"PAR1"


@pytest.mark.django_db
def test_an_mcap_file_is_asked_for_and_found_by_the_kind_of_its_pictures(rest, viewer, episode):
    path = f"episodes/{episode.uuid}/mcap"
    assert "is not made yet" in rest.get(path)[1]["error"]
    assert viewer.post(path)[0] == 403
    status, job = rest.post(f"{path}?pictures=jpeg")
    assert (status, job["kind"], job["key"]) == (202, "mcap", f"mcap:jpeg:{episode.uuid}")
    assert rest.get(path, pictures="png")[0] == 422


@pytest.mark.django_db
@pytest.mark.parametrize("what", ["export", "mcap"])
@pytest.mark.parametrize("method", ["get", "post"])
def test_an_episode_that_is_not_known_has_no_file(rest, tmp_path, method, what):
    folder: Path = recorded(tmp_path)
    for name in (folder.name, uuid.uuid4()):
        status, refused = getattr(rest, method)(f"episodes/{name}/{what}")
        assert (status, refused["error"]) == (404, f"episode {name} does not exist")
    assert not Episode.objects.exists()


@pytest.mark.django_db
def test_an_episode_is_published_on_demand_where_it_ever_is(rest, viewer, episode):
    path = f"episodes/{episode.uuid}/publish"
    assert viewer.post(path)[0] == 403
    status, job = rest.post(path)
    assert (status, job["kind"], job["key"]) == (202, "publish", f"publish:{episode.uuid}")
    for facts, said in (
        ({"mode": "sim"}, "no dataset ever holds it"),
        ({"status": "recording"}, "is still being recorded"),
    ):
        Episode.objects.filter(pk=episode.pk).update(**{"mode": "step", "status": "finished", **facts})
        status, refused = rest.post(path)
        assert status == 409
        assert said in refused["error"]
    assert Job.objects.filter(kind="publish").count() == 1
    assert rest.post(f"episodes/{uuid.uuid4()}/publish")[0] == 404
