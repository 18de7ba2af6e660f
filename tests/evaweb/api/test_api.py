import json
from pathlib import Path

import pytest
from django.conf import settings
from django.db import OperationalError
from django.test import Client
from django.urls import reverse

from evaweb.api.api import openapi_snapshot
from tests.evaweb.api.conftest import Rest

READS = [
    "me",
    "stations",
    "trials",
    "statistics",
    "episodes",
    "scenes",
    "checkpoints",
    "jobs",
    "openapi.json",
]


def test_the_snapshot_in_docs_is_the_interface_as_it_is(settings):
    kept = (Path(settings.BASE_DIR) / "docs" / "openapi.json").read_text("utf-8")
    assert json.loads(kept) == json.loads(openapi_snapshot()), (
        "run manage.py openapi_snapshot and read the difference"
    )


@pytest.mark.parametrize("path", READS)
def test_nobody_reads_anything_without_logging_in(db, path):
    status, body = Rest().get(path)
    assert status == 401
    assert "log in" in body["error"]


@pytest.mark.parametrize("path", READS)
def test_a_viewer_reads_everything(viewer, path):
    assert viewer.get(path)[0] == 200


@pytest.mark.parametrize(
    "path", ["stations/bench-1/trials", "trials/1/score", "trials/1/void", "stations/bench-1/estop"]
)
def test_nobody_changes_anything_without_logging_in(bench, path):
    assert Rest().post(path)[0] == 401


@pytest.mark.parametrize("token", ["eva_wrong", " ", "eva_\x00", "ü"])
def test_a_wrong_token_is_refused_even_beside_a_session(bench, token):
    browser = Client()
    browser.force_login(bench.operator)
    headers = {"Authorization": f"Bearer {token}"}
    assert browser.get("/api/v1/me", headers=headers).status_code == 401


def test_a_browser_needs_its_csrf_token_to_change_something_and_none_to_read(bench):
    browser = Client(enforce_csrf_checks=True)
    browser.force_login(bench.operator)
    assert browser.get("/api/v1/me").json() == {
        "username": "ann",
        "name": "",
        "role": "operator",
        "orcid": "",
    }
    body = json.dumps({"scene": "block-on-plate", "position": 1, "checkpoint": "pi0-block"})
    where = reverse("api:prepare", args=["bench-1"])
    refused = browser.post(where, body, content_type="application/json")
    assert refused.status_code == 403
    assert "CSRF" in refused.json()["error"]
    browser.get("/login/")
    browser.cookies[settings.CSRF_COOKIE_NAME] = token = "a" * 32
    done = browser.post(where, body, content_type="application/json", headers={"X-CSRFToken": token})
    assert done.status_code == 201


@pytest.mark.parametrize(
    ("path", "query", "sentence"),
    [
        ("trials", {"limit": 0}, "limit"),
        ("trials", {"limit": "many"}, "limit = 'many'"),
        ("trials", {"limit": 10**6}, "less than or equal to 1000"),
        ("trials", {"offset": -1}, "offset"),
        ("trials", {"format": "xml"}, "'json', 'csv' or 'parquet'"),
        ("episodes", {"status": "gone"}, "status = 'gone'"),
        (
            "trials",
            {"checkpont": "pi0-block"},
            "checkpont: unknown parameter; allowed: evaluation, checkpoint",
        ),
        ("statistics", {"limit": 5, "page": 2}, "limit, page: unknown parameter"),
        ("trials", {"format": "csv", "Status": "scored"}, "Status: unknown parameter"),
        ("me", {"of": "ann"}, "of: unknown parameter; allowed: none"),
    ],
)
def test_malformed_questions_are_answered_with_what_is_allowed(rest, path, query, sentence):
    status, body = rest.get(path, **query)
    assert status == 422
    assert sentence in body["error"]


def test_what_does_not_exist_is_not_found_in_json(rest):
    known = ("trials/999999", "trials/9999999999999999999999", "scenes/nope", "checkpoints/a/b")
    for path in (*known, "trails", "trials/", "episodes/no-uuid"):
        status, body = rest.get(path)
        assert status == 404, path
        assert "does not exist" in body["error"], path


def test_a_post_to_no_address_is_not_found_in_json(rest):
    status, body = rest.post("trials/1/scores", milestones={})
    assert status == 404
    assert "/api/v1/trials/1/scores does not exist" in body["error"]


def test_the_stop_is_never_refused_for_its_query(rest, wire):
    assert rest.post("stations/bench-1/estop?why=now")[0] == 200


def test_a_busy_database_is_a_sentence_and_503(rest, monkeypatch):
    def locked(*_, **__):
        raise OperationalError("database is locked")

    monkeypatch.setattr("evaweb.trials.selectors.trial_list", locked)
    status, body = rest.get("trials")
    assert status == 503
    assert "database is busy or gone" in body["error"]


@pytest.mark.exhaustive
def test_no_page_of_the_interface_fetches_anything_from_elsewhere(rest):
    assert rest.get("openapi.json")[1]["info"]["title"] == "EVA Web"
    assert Client().get("/api/v1/docs").status_code == 404


@pytest.mark.parametrize("text", ['"a\\ud800"', '"a\\u0000"', '"a\xed\xa0\x80"'])
def test_what_is_no_text_is_refused_by_name(rest, text):
    content = f'{{"checkpoint": {text}}}'.encode("latin-1")
    headers = {"Authorization": f"Bearer {rest.token}"}
    answer = Client().post("/api/v1/preflights", content, content_type="application/json", headers=headers)
    assert answer.status_code in (400, 422)
    assert answer.json()["error"].startswith(("checkpoint = 'a\\", "the body: is not valid JSON"))
