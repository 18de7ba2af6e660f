"""Quality, verdicts and annotations over REST."""

import pytest

from evaweb.jobs.models import Job
from evaweb.jobs.services import run_queue
from tests.evaweb.api.test_episodes import episode

__all__ = ["episode"]
pytestmark = pytest.mark.django_db


def test_an_episode_is_checked_and_its_flags_are_read(rest, viewer, episode):
    path = f"episodes/{episode.uuid}/quality"
    status, refused = rest.get(path)
    assert status == 404
    assert "has not been checked yet: POST to this address has it done" in refused["error"]
    assert viewer.post(path)[0] == 403
    status, job = rest.post(path)
    assert (status, job["kind"]) == (202, "quality")
    run_queue("cpu")
    assert Job.objects.get(kind="quality").error == ""
    status, report = viewer.get(path)
    assert status == 200
    assert report["frames"] == episode.frames
    assert {"kind", "severity", "first", "last", "stream", "text", "value", "bound"} == set(
        report["flags"][0]
    )


def test_a_verdict_a_note_and_a_segment_are_said_and_read(rest, viewer, episode):
    path = f"episodes/{episode.uuid}"
    assert rest.get("reviews/next")[1] == {"episode": str(episode.uuid), "waiting": 1}
    assert viewer.post(f"{path}/reviews", verdict="pass")[0] == 403
    status, said = rest.post(f"{path}/reviews", verdict="fail", note="it slips")
    assert status == 200
    assert (said["verdict"]["verdict"], said["verdict"]["note"]) == ("fail", "it slips")
    assert rest.get("reviews/next")[1] == {"episode": None, "waiting": 0}
    said = rest.post(f"{path}/segments", first=0, last=0, label="reach")[1]
    (segment,) = said["segments"]
    assert (segment["first"], segment["last"], segment["label"]) == (0, 0, "reach")
    said = rest.post(f"{path}/segments/{segment['uuid']}/remove")[1]
    assert said["segments"] == []
    assert len(viewer.get(f"{path}/reviews")[1]["reviews"]) == 1


def test_episodes_are_tagged_listed_by_tag_and_untagged(rest, viewer, episode):
    path = f"episodes/{episode.uuid}"
    assert viewer.post(f"{path}/tags", add=["cup"])[0] == 403
    status, changed = rest.post(f"{path}/tags", add=["Cup", "slips"])
    assert (status, changed) == (
        200,
        {"tags": ["cup", "slips"], "added": ["cup", "slips"], "removed": []},
    )
    assert rest.post(f"{path}/tags", add=["cup"], remove=["slips"])[1] == {
        "tags": ["cup"],
        "added": [],
        "removed": ["slips"],
    }
    assert viewer.get("reviews/tags")[1] == [{"words": "cup", "episodes": 1}]
    (found,) = viewer.get("episodes?tag=cup")[1]["items"]
    assert found["tags"] == viewer.get(path)[1]["tags"] == ["cup"]
    assert viewer.get("episodes?tag=slips")[1]["items"] == []
    assert "allowed: 1 to 60 characters" in rest.post(f"{path}/tags", add=["a,b"])[1]["error"]


def test_what_is_wrong_is_said(rest, episode):
    path = f"episodes/{episode.uuid}"
    assert "allowed: pass, fail, note" in rest.post(f"{path}/reviews", verdict="good")[1]["error"]
    status, refused = rest.post(f"{path}/segments", first=0, last=9999, label="reach")
    assert status == 400
    assert "allowed: frames 0 to" in refused["error"]
    assert rest.get("episodes/7b1c0f0e-0000-4000-8000-000000000000/reviews")[0] == 404
