"""A body is parsed when it is known that its sender may say anything there, and never more of it than is needed."""

from __future__ import annotations

import json
import uuid

import pytest
from django.test import Client

from evaweb.accounts.roles import Role
from evaweb.api.management.commands.openapi_snapshot import PLACE  # a test holds it to what the interface is
from evaweb.serving.body_limits import body_limit_for
from evaweb.stations.models import Command
from runtime.core import bounded_documents as bounded

pytestmark = pytest.mark.django_db
KIB = 1024


def posts():
    """The addresses that take a body."""
    for path, methods in sorted(json.loads(PLACE.read_text("utf-8"))["paths"].items()):
        if "requestBody" in methods.get("post", {}):
            numbered = path.startswith(("/api/v1/trials/", "/api/v1/references/"))
            yield path.replace("{id}", "1" if numbered else str(uuid.UUID(int=1)))


def address_of(path):
    for parameter, value in {
        "name": "bench-1",
        "uuid": str(uuid.UUID(int=1)),
        "segment": str(uuid.UUID(int=1)),
    }.items():
        path = path.replace("{" + parameter + "}", value)
    assert "{" not in path
    return path


ADDRESSES = [address_of(path) for path in posts()]
SHUT = [path for path in ADDRESSES if not path.endswith(("/estop", "/lease"))]
MANY = b"[" + b"[]," * 200_000 + b"[]]"


def posted(who, path, body):
    answer = Client().post(path, body, content_type="application/json", headers=who._headers() if who else {})
    return answer.status_code, answer.json()


@pytest.fixture
def unparsed(monkeypatch):
    monkeypatch.setattr(bounded, "parse_json", lambda *given, **named: pytest.fail("it was parsed"))


def test_of_a_viewer_and_of_a_stranger_nothing_is_parsed(viewer, unparsed):
    assert len(SHUT) > 15
    for path in SHUT:
        assert body_limit_for(path).role is Role.OPERATOR, path
        assert posted(None, path, MANY)[0] == 401, path
        status, answer = posted(viewer, path, MANY)
        assert (status, "vic is a viewer" in answer["error"]) == (403, True), path


def test_who_is_no_operator_any_more_can_give_a_station_up(viewer, bench, wire):
    status, answer = posted(viewer, "/api/v1/stations/bench-1/lease", b'{"action": "give_up", "page": "p"}')
    assert (status, answer["error"]) == (409, "this page does not have bench-1")


@pytest.mark.parametrize("path", SHUT)
def test_so_many_values_and_so_many_bytes_are_read(rest, path, monkeypatch):
    post = body_limit_for(path)
    status, answer = posted(rest, path, MANY[: post.largest - 3] + b"[]]")
    assert (status, answer["error"]) == (
        400,
        f"the body: more than {post.values} values; allowed: at most {post.values}",
    )
    monkeypatch.setattr(bounded, "parse_json", lambda *given, **named: pytest.fail("it was parsed"))
    status, answer = posted(rest, path, b'"' + b"x" * post.largest + b'"')
    assert (status, f"at most {post.largest}" in answer["error"]) == (413, True)


def command(**named):
    return json.dumps({"uuid": str(uuid.uuid4()), "page": "p", **named}).encode()


def test_a_command_of_more_than_256_kib_is_neither_parsed_nor_written(rest, bench, wire, unparsed):
    path = "/api/v1/stations/bench-1/commands"
    status, answer = posted(rest, path, command(kind="home", args={"x": "y" * 256 * KIB}))
    assert (status, f"allowed here: at most {256 * KIB}" in answer["error"]) == (413, True)
    assert not Command.objects.exists()
    assert not wire.heard


def test_a_long_command_that_presses_the_e_stop_is_a_press_of_a_viewer_too(viewer, bench, wire):
    path = "/api/v1/stations/bench-1/commands"
    assert posted(viewer, path, command(kind="estop", args={"x": "y" * 100 * KIB}))[0] == 200
    assert [heard.kind for heard in wire.heard] == ["estop"]


def test_of_many_faults_the_first_are_told(rest):
    score = {"milestones": {str(number): [] for number in range(500)}}
    status, answer = posted(rest, "/api/v1/trials/1/score", json.dumps(score).encode())
    assert status == 422
    assert answer["error"].endswith("; and 490 more")
    assert "Getter" not in posted(rest, "/api/v1/stations/bench-1/commands", b"{}")[1]["error"]


@pytest.mark.parametrize("body", [b"\\u", b'"\\u0000"', b"\xff", MANY])
def test_what_is_posted_where_nothing_is_read_does_nothing(rest, body):
    status, answer = posted(rest, "/api/v1/plans/nothing/reveal", body)
    assert (status, answer["error"]) == (404, "plan nothing does not exist; there are: none yet")


def test_an_unknown_field_is_refused_and_a_stop_never_is_for_one(rest, bench, wire):
    path = "/api/v1/stations/bench-1/commands"
    status, answer = posted(rest, path, command(kind="home", sequnce=4))
    assert (status, "sequnce = 4: unknown field" in answer["error"]) == (422, True)
    assert not wire.heard
    assert posted(rest, path, command(kind="stop", sequnce=4))[0] == 200
    assert posted(rest, "/api/v1/stations/bench-1/estop", b'{"kind": "x", "wy": 4}')[0] == 200


def test_every_body_but_that_of_a_press_refuses_unknown_fields():
    described = json.loads(PLACE.read_text("utf-8"))
    open_ = set()
    for path, methods in described["paths"].items():
        body = methods.get("post", {}).get("requestBody")
        taken = body and body["content"]["application/json"]["schema"]
        name = str(taken.get("$ref", "")).removeprefix("#/components/schemas/") if taken else ""
        if (
            taken
            and described["components"]["schemas"].get(name, {}).get("additionalProperties") is not False
        ):
            open_.add(path)
    # What a job about datasets takes is one of several, each of which refuses them.
    assert open_ == {"/api/v1/stations/{name}/estop", "/api/v1/datasets/jobs"}
