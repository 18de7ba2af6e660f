"""The application of the process for stops: what it answers, and which pages may read it."""

from __future__ import annotations

import json
from datetime import timedelta
from uuid import uuid4

import pytest
from django.conf import settings as lab
from django.contrib.sessions.models import Session
from django.db import connections
from django.test import Client
from django.utils import timezone

from evaweb.accounts.credentials import SESSION, credentials
from evaweb.api.stop_gateway import stop_application
from evaweb.api.tokens import create_token
from evaweb.stations import leases
from evaweb.stations.models import Command
from runtime.ipc.session_state import SessionState
from tests.evaweb.api.test_stop_gateway import asked, written
from tests.evaweb.noted import wait_for_stop_records

pytestmark = pytest.mark.django_db(transaction=True)
NAME, CSRF = lab.SESSION_COOKIE_NAME, lab.CSRF_COOKIE_NAME

ALONE = stop_application(8000)
HERE = {"host": "localhost:8001", "of": ALONE}
PAGE = {"origin": "http://localhost:8000"}


@pytest.fixture(autouse=True)
def _all_is_written():
    yield
    wait_for_stop_records()


@pytest.fixture
def session(ann):
    """The key of ann's session, which no process has seen yet."""
    browser = Client()
    browser.force_login(ann)
    connections.close_all()
    return browser.cookies[NAME].value


def test_who_asks_whether_it_stands_is_known_before_the_first_press(live, session):
    assert credentials.recall(SESSION, session) is None
    status, answer, told = asked("GET", f"{live.name}/estop", cookie=f"{NAME}={session}", **HERE, **PAGE)
    assert (status, answer) == (200, {"user": "ann", "alone": True})
    assert told["access-control-allow-origin"] == PAGE["origin"]
    assert told["access-control-allow-credentials"] == "true"
    assert credentials.recall(SESSION, session).username == "ann"


def test_the_web_says_that_it_is_not_alone(live, session):
    assert asked("GET", f"{live.name}/estop", cookie=f"{NAME}={session}")[:2] == (
        200,
        {"user": "ann", "alone": False},
    )
    assert asked("GET", f"{live.name}/estop", **HERE)[0] == 401


def test_a_press_is_done_and_written_down_once_however_many_ways_it_comes(live, session, runtime):
    press = {"uuid": str(uuid4()), "why": "both ways"}
    ways = [{**HERE, **PAGE, "content-type": "text/plain"}, {}]
    for way in ways:
        status, answer, _ = asked("POST", f"{live.name}/estop", press, cookie=f"{NAME}={session}", **way)
        assert (status, answer["status"]) == (200, "done")
    assert written(press["uuid"]).args == {"why": "both ways"}
    wait_for_stop_records()
    assert Command.objects.count() == 1


@pytest.mark.parametrize(
    "origin",
    ["http://localhost:8002", "https://localhost:8000", "http://evil.test:8000", "null", "http://[", ""],
)
def test_an_odd_origin_presses_and_reads_nothing(live, session, runtime, origin):
    status, _, told = asked("POST", f"{live.name}/estop", cookie=f"{NAME}={session}", origin=origin, **HERE)
    assert (status, len(runtime.pressed)) == (200, 1)
    assert "access-control-allow-origin" not in told
    assert told["vary"] == "origin"


def test_a_page_whose_name_leads_here_reads_nothing_and_stops_no_run_but_the_e_stop_is_never_refused(
    live, session, runtime
):
    led = {"host": "evil.test:8001", "origin": "http://evil.test:8001", "of": ALONE}
    given = {"cookie": f"{NAME}={session}", **led}
    for method, what in (("GET", "estop"), ("OPTIONS", "estop"), ("POST", "commands")):
        status, answer, told = asked(method, f"{live.name}/{what}", {"kind": "halt"}, **given)
        assert status == 400
        assert "EVA_ALLOWED_HOSTS" in answer["error"]
        assert "access-control-allow-origin" not in told
    status, _, told = asked("POST", f"{live.name}/estop", **given)
    assert (status, len(runtime.pressed)) == (200, 1)
    assert "access-control-allow-origin" not in told


def test_a_port_of_any_length_refuses_no_press(live, session, runtime):
    odd = {"host": f"localhost:{'9' * 5000}", "origin": f"http://localhost:{'9' * 5000}", "of": ALONE}
    assert asked("POST", f"{live.name}/estop", cookie=f"{NAME}={session}", **odd)[0] == 200


def test_pages_that_are_trusted_read_it_too(live, session, settings):
    settings.CSRF_TRUSTED_ORIGINS = ["https://lab.example.org"]
    given = {"cookie": f"{NAME}={session}", "origin": "https://lab.example.org"}
    told = asked("GET", f"{live.name}/estop", **given, **HERE)[2]
    assert told["access-control-allow-origin"] == "https://lab.example.org"


def test_a_browser_is_told_what_it_may_send_from_our_pages_alone(live):
    for origin, allowed in ((PAGE["origin"], True), ("http://localhost:9000", False)):
        status, _, told = asked("OPTIONS", f"{live.name}/commands", origin=origin, **HERE)
        assert (status, "access-control-allow-origin" in told) == (200, allowed)
        assert told["access-control-allow-headers"] == "content-type, x-csrftoken"


def test_a_stop_needs_the_csrf_token_and_a_page_of_ours(live, ann, session, runtime):
    runtime.ready()
    lease = leases.claim(user=ann, station=live, page="p1")
    runtime.do(lambda: runtime.session._enter(SessionState.RUNNING, ""))
    connections.close_all()
    token = {"cookie": f"{NAME}={session}; {CSRF}={'a' * 32}", "x-csrftoken": "a" * 32}

    def halted(**given):
        order = {"uuid": str(uuid4()), "kind": "halt", "page": "p1", "epoch": lease.epoch}
        return asked("POST", f"{live.name}/commands", order, **HERE, **given)[0]

    assert halted(cookie=f"{NAME}={session}", **PAGE) == 403
    assert halted(**token, origin="http://localhost:8002") == 403
    assert halted(**token, origin="http://evil.test") == 403
    assert [one.kind for one in runtime.commands].count("halt") == 0
    assert halted(**token, **PAGE) == 200


def test_a_session_whose_time_is_over_presses_and_does_nothing_else(live, session, runtime):
    Session.objects.update(expire_date=timezone.now() - timedelta(days=1))
    connections.close_all()
    given = {"cookie": f"{NAME}={session}", **HERE, **PAGE}
    assert asked("GET", f"{live.name}/estop", **given)[:2] == (200, {"user": "ann", "alone": True})
    assert asked("POST", f"{live.name}/estop", **given)[0] == 200
    assert [press.user for press in runtime.pressed] == ["ann"]
    halt = {"uuid": str(uuid4()), "kind": "halt", "page": "p1"}
    assert asked("POST", f"{live.name}/commands", halt, **given)[0] == 401


def test_everything_else_is_said_to_be_at_the_web(live, ann):
    token = create_token(user=ann, name="tests")
    for method, path in (("GET", ""), ("POST", f"{live.name}/commands"), ("PUT", f"{live.name}/estop")):
        status, answer, _ = asked(method, path, {"kind": "home"}, token=token, **HERE)
        assert (status, "the web is at port 8000" in answer["error"]) == (404, True)


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"page": "p1"}, "uuid: Field required"),
        ({"page": "p1", "uuid": "5"}, "uuid = '5': "),
        ({"page": "a b", "uuid": str(uuid4())}, "page = 'a b': "),
        ({"page": "p1", "uuid": str(uuid4()), "epoch": -1}, "epoch = -1: "),
    ],
)
@pytest.mark.parametrize("kind", ["stop", "halt"])
def test_a_stop_that_lacks_something_is_told_what_as_the_pages_own_interface_says_it(
    live, ann, runtime, kind, given, named
):
    token = create_token(user=ann, name="tests")
    connections.close_all()
    path = f"{live.name}/commands"
    here = asked("POST", path, {"kind": kind, **given}, token=token, **HERE)[:2]
    described = Client().post(
        f"/api/v1/stations/{path}",
        json.dumps({"kind": kind, **given}),
        "application/json",
        headers={"Authorization": f"Bearer {token}"},
    )
    assert here == (described.status_code, described.json())
    assert here[0] == 422
    assert here[1]["error"].startswith(named)
    assert runtime.commands == []
