"""Sessions over REST: what they are, what is done with them, and commands that name them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from django.contrib.auth.models import User
from django.test import Client

from evaweb.collect.models import CollectSession
from evaweb.jobs.models import Job
from evaweb.stations.models import Station
from tests.evaweb.collect.conftest import (
    Demonstrate,
    at,
    data,
    demonstrate,
    labelled,
    recorded,
    session,
    station,
)
from tests.evaweb.trials.builders import FakeConnection

__all__ = ["at", "data", "demonstrate", "recorded", "session", "station"]
pytestmark = pytest.mark.django_db
PAGE = {"page": "p1", "epoch": 1, "boot": "b", "sequence": 1}


@pytest.fixture
def browser(client: Client, ann: User) -> Client:
    client.force_login(ann)
    return client


def post(browser: Client, path: str, **content: Any) -> Any:
    return browser.post(f"/api/v1/{path}", json.dumps(content), content_type="application/json")


def test_a_session_is_opened_listed_and_closed(
    browser: Client, at: FakeConnection, data: Path, station: Station
) -> None:
    made = post(browser, "stations/bench/sessions", task="stack the cups", target=3)
    assert (made.status_code, made.json()["dataset"], made.json()["operator"]) == (201, "cups", "ann")
    page = browser.get("/api/v1/sessions?station=bench&open=true").json()
    assert (page["total"], page["items"]) == (1, [made.json()])
    uuid = made.json()["uuid"]
    assert post(browser, f"sessions/{uuid}/target", target=None).json()["target"] is None
    assert post(browser, f"sessions/{uuid}/close").json()["closed_at"] is not None
    assert browser.get("/api/v1/sessions?open=true").json()["total"] == 0
    assert post(browser, f"sessions/{uuid}/resume").json()["closed_at"] is None
    refused = post(browser, "stations/bench/sessions", task="another")
    assert (refused.status_code, "close it first" in refused.json()["error"]) == (409, True)
    assert browser.get(f"/api/v1/sessions/{uuid4()}").status_code == 404


def test_one_session_comes_with_its_episodes_and_their_queue(
    browser: Client, session: CollectSession, demonstrate: Demonstrate
) -> None:
    made = demonstrate("success")
    told = browser.get(f"/api/v1/sessions/{session.pk}").json()
    assert (told["counts"]["saved"], told["counts"]["success"], told["folder"]) == (1, 1, "cups")
    assert [(one["episode"], one["result"]) for one in told["episodes"]] == [(str(made.pk), "success")]
    assert [event["kind"] for event in told["events"]] == ["opened"]
    assert told["setup"]["robot"] == "agilex_piper"
    queue = browser.get(f"/api/v1/sessions/{session.pk}/queue").json()
    assert [(item["kind"], item["episode"], item["left_s"]) for item in queue["items"]] == [
        ("preview", str(made.pk), None)
    ]
    asked = post(browser, f"sessions/{session.pk}/publish", version="v3.0")
    assert (asked.status_code, [job["kind"] for job in asked.json()]) == (202, ["publish"])
    assert post(browser, f"sessions/{session.pk}/publish", results=["lost"]).status_code == 422


def test_a_job_that_failed_is_tried_again_and_no_other(browser: Client, vera: User) -> None:
    failed = Job.objects.create(kind="preview", key="preview:1", status="failed", error="no space")
    again = post(browser, f"jobs/{failed.pk}/retry")
    assert (again.status_code, again.json()["status"]) == (202, "queued")
    refused = post(browser, f"jobs/{again.json()['id']}/retry")
    assert (refused.status_code, "only one that failed" in refused.json()["error"]) == (409, True)
    assert post(browser, "jobs/99999/retry").status_code == 404
    browser.force_login(vera)
    assert post(browser, f"jobs/{failed.pk}/retry").status_code == 403


def test_a_command_for_a_session_is_one_of_its_station(
    browser: Client, session: CollectSession, at: FakeConnection, station: Station
) -> None:
    run = post(
        browser, "stations/bench/commands", uuid=str(uuid4()), kind="run", session=str(session.pk), **PAGE
    )
    assert (run.status_code, run.json()["status"]) == (200, "accepted")
    assert at.heard[-1].args["session"] == {"uuid": str(session.pk), "dataset": "cups"}
    both = {"session": str(session.pk), "trial": 1}
    refused = post(browser, "stations/bench/commands", uuid=str(uuid4()), kind="run", **both, **PAGE)
    assert (refused.status_code, refused.json()["error"][:17]) == (400, "trial and session")
    Station.objects.create(name="other", robot="agilex_piper")
    elsewhere = post(
        browser, "stations/other/commands", uuid=str(uuid4()), kind="run", session=both["session"], **PAGE
    )
    assert "is one of bench, not of other" in elsewhere.json()["error"]


def test_a_demonstration_is_published_alone_only_where_its_session_would(
    browser: Client, data: Path, demonstrate: Demonstrate
) -> None:
    made = demonstrate(result="fail")
    answer = post(browser, f"episodes/{made.pk}/publish")
    assert answer.status_code == 409
    assert "it has to be labelled success or partial" in answer.json()["error"]
    labelled(data, made, "success")
    assert post(browser, f"episodes/{made.pk}/publish").status_code == 202
