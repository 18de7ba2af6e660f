"""What stops a robot over REST, through the whole application as it is served."""

from __future__ import annotations

import asyncio
import json
import threading
from datetime import timedelta
from uuid import uuid4

import pytest
from asgiref.testing import ApplicationCommunicator
from django.conf import settings as lab
from django.contrib.sessions.models import Session
from django.db import OperationalError, connections
from django.test import Client
from django.utils import timezone

from evaweb.accounts import credentials as module
from evaweb.accounts import login_audit
from evaweb.accounts.credentials import credentials
from evaweb.accounts.lookup_pool import FairLookupPool
from evaweb.api.models import Token
from evaweb.api.tokens import create_token
from evaweb.asgi import application
from evaweb.core.log_throttle import LogThrottle
from evaweb.stations import leases
from evaweb.stations.models import Command
from runtime.ipc.session_state import SessionState
from tests import presses
from tests.evaweb.noted import wait_for_stop_records
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.django_db(transaction=True)
NAME, CSRF = lab.SESSION_COOKIE_NAME, lab.CSRF_COOKIE_NAME


@pytest.fixture(autouse=True)
def _data_dir():
    """Stand-ins leave their endpoints where the settings of all tests say; nothing is left to be written there."""
    yield
    wait_for_stop_records()


@pytest.fixture(autouse=True)
def _nobody_was_refused_before(monkeypatch):
    monkeypatch.setattr(login_audit, "_refused", LogThrottle(60.0, 10))


@pytest.fixture
def token(ann):
    return create_token(user=ann, name="tests")


@pytest.fixture
def away(monkeypatch):
    """The database of credentials; `set` makes it go away."""
    gone, look = threading.Event(), credentials.look_up

    def looked(kind, secret):
        if gone.is_set():
            raise OperationalError("gone")
        return look(kind, secret)

    monkeypatch.setattr(credentials, "look_up", looked)
    return gone


def post(path, body=None, **given):
    """Status and JSON of POST /api/v1/stations/PATH."""
    status, answer, _ = asked("POST", path, body, **given)
    return status, answer


def asked(method, path, body=None, *, token=None, cookie=None, of=application, **headers):
    """Status, JSON and headers of what the application answers to METHOD /api/v1/stations/PATH."""

    async def ask():
        sent = body if isinstance(body, bytes) else json.dumps(body or {}).encode()
        given = {"host": "localhost", "content-type": "application/json", **headers}
        if token is not None:
            given["authorization"] = f"Bearer {token}"
        if cookie is not None:
            given["cookie"] = cookie
        scope = {
            "type": "http",
            "http_version": "1.1",
            "method": method,
            "scheme": "http",
            "path": f"/api/v1/stations/{path}",
            "raw_path": b"",
            "query_string": b"",
            "headers": [(name.encode(), value.encode("latin-1")) for name, value in given.items()],
            "client": ("127.0.0.1", 1),
            "server": ("127.0.0.1", 80),
        }
        served = ApplicationCommunicator(of, scope)
        await served.send_input({"type": "http.request", "body": sent, "more_body": False})
        start = await served.receive_output(PATIENCE_S)
        parts, more = [], True
        while more:
            message = await served.receive_output(PATIENCE_S)
            parts.append(message.get("body", b""))
            more = message.get("more_body", False)
        await served.wait(PATIENCE_S)
        told = {name.decode().lower(): value.decode() for name, value in start["headers"]}
        return start["status"], json.loads(b"".join(parts)), told

    return asyncio.run(ask())


def written(uuid):
    eventually(lambda: Command.objects.filter(pk=uuid).exists(), "it is written down")
    return Command.objects.get(pk=uuid)


def test_an_e_stop_is_pressed_and_written_down_and_the_same_as_the_described_one(live, ann, token, runtime):
    uuid = str(uuid4())
    status, answer = post(f"{live.name}/estop", {"uuid": uuid, "why": "smoke"}, token=token)
    assert (status, answer["uuid"], answer["status"]) == (200, uuid, "done")
    described = Client().post(
        f"/api/v1/stations/{live.name}/estop",
        "{}",
        "application/json",
        headers={"Authorization": f"Bearer {token}"},
    )
    assert described.json().keys() == answer.keys()
    row = written(uuid)
    assert (row.user, row.args) == (ann, {"why": "smoke"})
    assert runtime.pressed[0].user == "ann"


@pytest.mark.parametrize(
    "body", [b"", b"null", b"[]", b"[" * 9000, b'{"uuid": 5, "why": 7}', b"\xff" * 99_999]
)
def test_a_press_is_not_refused_for_what_is_said_with_it(live, token, runtime, body):
    assert post(f"{live.name}/estop", body, token=token)[0] == 200
    assert [command.args["why"] for command in runtime.pressed] == ["pressed"]


@pytest.mark.parametrize("name", presses.in_json("kind"))
@pytest.mark.parametrize("path", ["estop", "commands"])
def test_whatever_is_wrong_with_a_press_among_the_commands_it_is_pressed(live, token, runtime, path, name):
    body = presses.in_json("kind")[name].encode()
    status, answer = post(f"{live.name}/{path}", body, token=token, **{"content-type": "text/odd"})
    assert (status, answer["status"]) == (200, "done")
    assert len(runtime.pressed) == 1


def test_a_browser_presses_without_its_csrf_token_and_stops_with_it(live, ann, runtime):
    browser = Client()
    browser.force_login(ann)
    connections.close_all()
    session = f"{NAME}={browser.cookies[NAME].value}"
    assert post(f"{live.name}/estop", cookie=session)[0] == 200
    stop = {"uuid": str(uuid4()), "kind": "stop", "page": "p1", "epoch": 1}
    status, answer = post(f"{live.name}/commands", stop, cookie=session)
    assert (status, answer) == (
        403,
        {"error": "CSRF check Failed", "id": "api.door.csrf_check_failed", "arguments": {}},
    )
    assert runtime.commands == []
    both = f"{session}; {CSRF}={'a' * 32}"
    assert post(f"{live.name}/commands", stop, cookie=both, **{"x-csrftoken": "a" * 32})[0] in (200, 409)
    assert [command.kind for command in runtime.commands] == ["stop"]
    written(stop["uuid"])


@pytest.mark.parametrize("path", ["estop", "commands"])
def test_nobody_at_all_and_a_made_up_token_are_refused_in_json(live, runtime, path):
    body = {"uuid": str(uuid4()), "kind": "halt", "page": "p1"}
    for headers in (
        {},
        {"token": "eva_made_up"},
        {"cookie": f"{NAME}=madeup"},
        {"cookie": f"{NAME}=\x01; ="},
    ):
        status, answer = post(f"{live.name}/{path}", body, **headers)
        assert (status, list(answer)) == (401, ["error", "id", "arguments"])
    assert runtime.pressed == []
    assert runtime.commands == []


@pytest.mark.parametrize(
    "beside",
    [
        {"cookie": 'prefs={"a":1}; SESSION'},
        {"cookie": "bare; a[1]=2; path=/; _ga=GA1,2 3; SESSION; name=b\xe4r"},
        {"cookie": "SESSION", "authorization": "Basic Zm9vOmJhcg=="},
        {"cookie": "SESSION", "authorization": "Bearer eva_made_up"},
    ],
)
def test_what_else_a_browser_sends_hides_no_session(live, ann, runtime, beside):
    browser = Client()
    browser.force_login(ann)
    connections.close_all()
    session = f"{NAME}={browser.cookies[NAME].value}"
    assert (
        post(f"{live.name}/estop", **(beside | {"cookie": beside["cookie"].replace("SESSION", session)}))[0]
        == 200
    )
    assert [command.user for command in runtime.pressed] == ["ann"]


@pytest.mark.parametrize("order", [slice(None), slice(None, None, -1)])
def test_of_several_cookies_of_a_name_any_is_good(live, ann, runtime, order):
    browser = Client()
    browser.force_login(ann)
    connections.close_all()
    sessions = [f"{NAME}=elsewhere", f"{NAME}={browser.cookies[NAME].value}"][order]
    tokens = [f"{CSRF}={letter * 32}" for letter in "ab"][order]
    given = {"cookie": "; ".join(sessions + tokens), "x-csrftoken": "a" * 32}
    assert post(f"{live.name}/estop", **given)[0] == 200
    assert [command.user for command in runtime.pressed] == ["ann"]
    halt = {"uuid": str(uuid4()), "kind": "halt", "page": "p1"}
    assert post(f"{live.name}/commands", halt, **given)[0] in (200, 409)
    assert post(f"{live.name}/commands", halt, **{**given, "x-csrftoken": "c" * 32})[0] == 403
    assert [command.kind for command in runtime.commands] == ["halt"]


def test_cookies_that_are_made_up_hide_no_session_that_is_remembered(live, ann, runtime):
    browser = Client()
    browser.force_login(ann)
    connections.close_all()
    mine = f"{NAME}={browser.cookies[NAME].value}"
    assert post(f"{live.name}/estop", cookie=mine)[0] == 200
    many = "; ".join([*(f"{NAME}=made{number}up" for number in range(20)), mine])
    assert post(f"{live.name}/estop", cookie=many)[0] == 200
    assert [command.user for command in runtime.pressed] == ["ann", "ann"]


@pytest.mark.parametrize("what", ["estop", "commands"])
def test_who_has_no_turn_presses_unverified_stops_nothing_else_and_whoever_is_remembered_does(
    live, ann, token, runtime, monkeypatch, what
):
    """The database answers, and others from that address are before them."""
    assert post(f"{live.name}/estop", token=token)[0] == 200
    full, begun, turn = FairLookupPool(1, most=1), threading.Event(), threading.Event()
    full.submit("127.0.0.1", lambda: begun.set() or turn.wait(PATIENCE_S))
    assert begun.wait(PATIENCE_S)
    full.submit("127.0.0.1", lambda: None)
    monkeypatch.setattr(credentials, "_strangers", full)
    body = {"uuid": str(uuid4()), "kind": "halt", "page": "p1"}
    status, answer, told = asked("POST", f"{live.name}/{what}", body, token="eva_unknown")
    if what == "estop":  # which no crowd refuses
        assert status == 200
        assert [command.user for command in runtime.pressed[1:]] == ["unverified"]
    else:
        assert (status, told["retry-after"]) == (503, "1")
        assert "too many logins from this address are looked up at once" in answer["error"]
        assert "the e-stop works" in answer["error"]
    assert asked("GET", f"{live.name}/estop", token="eva_unknown")[0] == 503
    obeyed = len(runtime.pressed)
    assert runtime.commands == []
    both = {"token": token, "cookie": f"{NAME}=unknown"}
    assert post(f"{live.name}/{what}", {**body, "uuid": str(uuid4())}, **both)[0] in (200, 409)
    turn.set()
    assert len(runtime.pressed) + len(runtime.commands) == obeyed + 1


def test_a_session_whose_time_is_over_presses_the_e_stop_and_nothing_else(live, ann, runtime):
    browser = Client()
    browser.force_login(ann)
    key = browser.cookies[NAME].value
    Session.objects.update(expire_date=timezone.now() - timedelta(days=1))
    connections.close_all()
    assert post(f"{live.name}/estop", cookie=f"{NAME}={key}")[0] == 200
    assert [command.user for command in runtime.pressed] == ["ann"]
    halt = {"uuid": str(uuid4()), "kind": "halt", "page": "p1"}
    assert post(f"{live.name}/commands", halt, cookie=f"{NAME}={key}")[0] == 401
    Session.objects.all().delete()
    credentials.forget("session of any age", module.digest(key))
    connections.close_all()
    assert post(f"{live.name}/estop", cookie=f"{NAME}={key}")[0] == 401


def test_whatever_goes_wrong_with_a_press_is_said_with_the_hardware_stop(live, token, monkeypatch):
    def broken(**named):
        raise OSError(36, "File name too long")

    monkeypatch.setattr("evaweb.stations.stops.press_estop", broken)
    status, answer = post(f"{live.name}/estop", token=token)
    assert (status, answer) == (500, {"error": "USE THE HARDWARE STOP: OSError"})


def test_a_station_of_a_long_name_is_none(token):
    assert post(f"{'x' * 3000}/estop", token=token)[0] == 404


def test_without_the_database_who_is_remembered_stops_and_anybody_presses(live, ann, token, runtime, away):
    runtime.ready()
    lease = leases.claim(user=ann, station=live, page="p1")
    runtime.do(lambda: runtime.session._enter(SessionState.RUNNING, ""))
    assert post(f"{live.name}/estop", token=token)[0] == 200
    away.set()
    halt = {"uuid": str(uuid4()), "kind": "halt", "page": "p1", "epoch": lease.epoch}
    assert post(f"{live.name}/commands", halt, token=token)[1]["status"] == "accepted"
    assert post(f"{live.name}/estop", token=token)[0] == 200
    for credential in ({"authorization": "Basic x"}, {"cookie": f"{NAME}=unknown"}):
        assert post(f"{live.name}/estop", **credential)[0] == 200
    unknown = str(uuid4())  # of one second's the newest has a row
    assert post(f"{live.name}/estop", {"uuid": unknown}, token="eva_unknown")[0] == 200
    assert [command.user for command in runtime.pressed[2:]] == ["unverified"] * 3
    assert post(f"{live.name}/estop")[0] == 401, "without any credential there is nothing to verify"
    status, answer = post(f"{live.name}/commands", {**halt, "uuid": str(uuid4())}, token="eva_unknown")
    assert status == 503
    assert "who may stop is not known; the e-stop works" in answer["error"]
    away.clear()
    row = written(unknown)
    assert row.user is None
    assert "the database does not answer" in row.args["unverified"]


def test_a_token_that_was_withdrawn_counts_no_more_once_the_database_is_back(
    live, ann, token, runtime, away, monkeypatch
):
    assert post(f"{live.name}/estop", token=token)[0] == 200
    away.set()
    ann.api_tokens.model.objects.filter(user=ann)._raw_delete("default")  # by another process
    assert post(f"{live.name}/estop", token=token)[0] == 200
    away.clear()
    monkeypatch.setattr(module, "_FRESH_S", 0.0)
    stop = {"uuid": str(uuid4()), "kind": "stop", "page": "p1", "epoch": 1}
    assert post(f"{live.name}/commands", stop, token=token)[0] == 401
    assert post(f"{live.name}/estop", token=token)[0] == 401
    assert runtime.commands == []


def test_a_viewers_stop_is_refused_before_anything_is_done_and_the_press_is_not(live, vera, runtime):
    token = create_token(user=vera, name="tests")
    connections.close_all()
    for kind in ("stop", "halt"):
        status, answer = post(
            f"{live.name}/commands", {"uuid": str(uuid4()), "kind": kind, "page": "p1"}, token=token
        )
        assert status == 403
        assert "vera is a viewer; this needs an operator" in answer["error"]
    assert post(f"{live.name}/commands", {"kind": "estop", "uuid": "x", "page": 5}, token=token)[0] == 200
    assert (runtime.commands, len(runtime.pressed)) == ([], 1)


def test_a_press_among_the_commands_is_one_however_much_else_is_said(live, vera, runtime):
    token, long = create_token(user=vera, name="tests"), {"kind": "estop", "args": {"x": "y" * 100_000}}
    connections.close_all()
    assert post(f"{live.name}/commands", long, token=token)[0] == 200
    assert (runtime.commands, len(runtime.pressed)) == ([], 1)


def test_what_stops_nothing_goes_on_to_the_application(live, token, runtime):
    for given in (
        {"kind": "home"},
        {"kind": "stop", "page": "a b"},
        {"kind": "x" * 99_999},
        [],
        {"kind": ["stop"]},
    ):
        body = {"uuid": str(uuid4()), "page": "p1", **given} if isinstance(given, dict) else given
        status, answer = post(f"{live.name}/commands", body, token=token)
        assert status in (400, 409, 422)
        said = set(answer) - {"id", "arguments"}
        assert said in ({"error"}, {"uuid", "status", "reason", "allowed", "data"})


def test_names_that_are_no_station_are_said_to_be_none(token):
    assert post("bench%201/estop", token=token)[0] == 404
    status, answer = post("no-such-bench/estop", token=token)
    assert status == 409
    assert answer["reason"].startswith("USE THE HARDWARE STOP")
    assert not Command.objects.exists()


@pytest.mark.parametrize("remembered", [False, True])
def test_a_token_whose_time_is_over_presses_the_e_stop_and_nothing_else(live, ann, token, caplog, remembered):
    if remembered:
        assert post(f"{live.name}/estop", token=token)[0] == 200
    Token.objects.update(ends_at=timezone.now())
    credentials.forget("token", module.digest(token))
    assert post(f"{live.name}/estop", token=token)[0] == 200
    status, said = post(
        f"{live.name}/commands", {"kind": "halt", "page": "p", "uuid": str(uuid4())}, token=token
    )
    assert status == 401
    assert "its time is over" in said["error"]
    assert "a token from 127.0.0.1 is not known, or its time is over" in caplog.text


@pytest.mark.parametrize("by", ["password", "hand"])
def test_a_token_that_was_withdrawn_presses_nothing(live, ann, token, by):
    post(f"{live.name}/estop", token=token)
    if by == "hand":
        Token.objects.get().delete()
    else:
        ann.set_password("another-one-3")
        ann.save()
    assert post(f"{live.name}/estop", token=token)[0] == 401


def test_text_that_is_none_stops_all_the_same(live, token):
    for text in (rb'"a\ud800"', rb'"a\u0000"', b'"a\xed\xa0\x80"'):
        assert post(f"{live.name}/estop", b'{"why": ' + text + b"}", token=token)[0] == 200
