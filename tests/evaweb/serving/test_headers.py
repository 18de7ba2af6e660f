"""Every answer says where its parts may come from, and what is behind the login is kept in no cache."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from django.conf import settings
from django.test import Client
from django.urls import get_resolver, reverse

from tests.evaweb.crawling import named

pytestmark = pytest.mark.django_db
VALUES = {
    "digest": "0" * 64, "uuid": "0" * 8 + "-0000-0000-0000-" + "0" * 12, "id": 1, "version": 1, "index": 0,
    "segment": "0" * 8 + "-0000-0000-0000-" + "0" * 12,
}  # fmt: skip
SHAPES = ("robot-mesh",)  # which say nothing of the lab


OWN = {
    "preflight": {"id": VALUES["uuid"]},
    "api:preflight": {"id": VALUES["uuid"]},
    "picture": {"name": "0" * 64},
}


def addresses():
    for name, parameters in sorted(named(get_resolver())):
        values = {one: VALUES.get(one, "x") for one in parameters}
        yield name, reverse(name, kwargs=values | OWN.get(name, {}))


def policy(answer):
    parts = [part.split() for part in answer["Content-Security-Policy"].split("; ")]
    return {part[0]: part[1:] for part in parts}


def test_every_address_answers_with_the_policy_and_no_cache_keeps_it(alma, nobody_computes):
    client, stranger = Client(raise_request_exception=False), Client()
    client.force_login(alma)
    asked = [("admin", "/admin/"), ("nowhere", "/nowhere"), ("openapi", "/api/v1/openapi.json"), *addresses()]
    assert len(asked) > 100
    for name, path in asked:
        for who in (client, stranger):
            answer = who.get(path)
            assert policy(answer)["script-src"] == ["'self'"], path
            assert name in SHAPES or answer["Cache-Control"] in ("no-store", _NEVER), path


_NEVER = "max-age=0, no-cache, no-store, must-revalidate, private"  # Django's own, of its login pages


def test_the_policy_lets_nothing_in_from_elsewhere(client):
    told = policy(client.get("/login/"))
    assert told["default-src"] == ["'self'"]
    assert told["frame-ancestors"] == told["object-src"] == told["base-uri"] == ["'none'"]
    assert not {"'unsafe-inline'", "'unsafe-eval'", "*"} & {word for words in told.values() for word in words}


def test_a_page_with_a_style_of_its_own_names_its_number_and_another_one_each_time(client, ann, live):
    client.force_login(ann)
    numbers = set()
    for _ in range(2):
        answer = client.get(f"/stations/{live.name}/debug/")
        (number,) = re.findall(r'<style nonce="([^"]+)">', answer.content.decode())
        assert f"'nonce-{number}'" in policy(answer)["style-src"]
        numbers.add(number)
    assert len(numbers) == 2


@pytest.mark.parametrize("seconds", [0, 3600])
def test_over_https_browsers_are_told_to_come_over_it_again(client, settings, seconds):
    settings.SECURE_HSTS_SECONDS = seconds
    answer = client.get("/login/", secure=True)
    assert answer.headers.get("Strict-Transport-Security") == (f"max-age={seconds}" if seconds else None)
    assert "Strict-Transport-Security" not in client.get("/login/").headers


ATTRIBUTES = re.compile(r"\s(style|on[a-z]+)=|href=\"javascript:|<script(?![^>]*\bsrc=)", re.IGNORECASE)


def test_no_template_has_what_the_policy_forbids():
    templates = sorted(Path(settings.BASE_DIR, "templates").rglob("*.html"))
    assert len(templates) > 80
    assert [path.name for path in templates if ATTRIBUTES.search(path.read_text("utf-8"))] == []


def test_a_name_that_is_none_of_the_labs_is_one_line_of_the_log(caplog):
    assert Client().get("/", headers={"host": "elsewhere.example"}).status_code == 400
    (record,) = [one for one in caplog.records if one.name == "django.security.DisallowedHost"]
    assert "elsewhere.example" in record.getMessage()
    assert record.exc_info is None
