"""The panel as a real process: who is let in, what is stopped, and what it withstands."""

from __future__ import annotations

import http.client
import json
import socket
from uuid import uuid4

import pytest

from runtime.core.errors import TransportError
from runtime.ipc.bus import Endpoints
from runtime.ipc.session_state import SessionState
from runtime.link.uplink import Telling
from tests.e2e.tls_proxy import certificate
from tests.processes import eventually
from tests.runtime.clients.panel.served import PIN, STATION, Served

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def panel(tmp_path_factory):
    """Shared: what a test fills it empties."""
    made = Served(tmp_path_factory.mktemp("panel"))
    yield made
    made.end()


def presses(panel, work):
    """How many presses reach the guard while `work` is done, and what it returns."""
    before = len(panel.station.pressed)
    found = work()
    return len(panel.station.pressed) - before, found


def test_the_estop_needs_no_pin_and_says_where_it_was_pressed(panel):
    count, (status, _, content) = presses(panel, lambda: panel.ask("POST", "/estop", {"uuid": str(uuid4())}))
    assert (count, status) == (1, 200)
    assert json.loads(content) == {"done": True, "text": "every tick now sends the measured position"}
    press = panel.station.pressed[-1]
    assert (press.user, press.role) == ("panel:127.0.0.1", "local")
    assert press.args["why"] == "at the station's panel, from 127.0.0.1"


@pytest.mark.parametrize("body", ["", "nonsense", "[1]", "x" * 5000])
def test_no_press_is_lost_for_what_is_in_it(panel, body):
    def press():
        connection = panel.connection()
        connection.request("POST", "/estop", body, {"X-EVA-Panel": "1"})
        status = connection.getresponse().status
        connection.close()
        return status

    assert presses(panel, press) == (1, 200)


def test_a_form_of_the_page_itself_presses_where_its_script_does_not_run(panel):
    own = {"Origin": panel.url, "Content-Type": "application/x-www-form-urlencoded"}
    count, (status, headers, content) = presses(panel, lambda: panel.ask("POST", "/estop", headers=own))
    assert (count, status, headers["Content-Type"]) == (1, 200, "text/plain; charset=utf-8")
    assert content.decode() == "every tick now sends the measured position\n"


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "http://evil.example", "X-EVA-Panel": "1"}, 403),
        ({"X-EVA-Panel": "1", "Sec-Fetch-Site": "cross-site"}, 403),
        ({}, 403),
        ({"Host": "evil.example", "X-EVA-Panel": "1"}, 421),
        ({"Host": "evil.example", "Origin": "http://evil.example"}, 421),
    ],
)
@pytest.mark.parametrize("path", ["/estop", "/stop", "/pin"])
def test_a_page_of_another_origin_can_do_nothing(panel, path, headers, status):
    count, (said, _, content) = presses(panel, lambda: panel.ask("POST", path, {"pin": PIN}, headers))
    assert (count, said) == (0, status)
    assert json.loads(content)["done"] is False


def test_a_page_of_another_name_is_not_even_shown(panel):
    assert panel.ask("GET", "/", headers={"Host": "evil.example"})[0] == 421
    status, headers, content = panel.ask("GET", "/")
    assert status == 200
    assert STATION in content.decode()
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "frame-ancestors 'none'" in policy
    assert "unsafe" not in policy


@pytest.mark.parametrize(
    ("method", "path"), [("GET", "/state"), ("GET", "/camera/cam_high"), ("POST", "/stop")]
)
def test_state_pictures_and_stop_ask_for_the_pin(panel, method, path):
    before = len(panel.station.commands)
    assert panel.ask(method, path)[0] == 401
    forged = {"X-EVA-Panel": "1", "Cookie": "eva-panel=guessed"}
    assert panel.ask(method, path, headers=forged)[0] == 401
    assert len(panel.station.commands) == before


def test_nothing_that_moves_and_no_release_is_offered(panel):
    entered = panel.entered()
    for path in ("/release", "/run", "/resume", "/home", "/setup"):
        assert panel.ask("POST", path, {}, entered)[0] == 404


def test_who_has_given_the_pin_sees_the_station_and_its_pictures(panel):
    entered = panel.entered()

    def seen():
        told = json.loads(panel.ask("GET", "/state", headers=entered)[2])
        return told if told["cameras"] and "state" in told else None

    told = eventually(seen, "the station")
    assert (told["station"], told["silent_s"], told["lab"]) == (STATION, 0, None)
    status, headers, jpeg = panel.ask("GET", "/camera/cam_high", headers=entered)
    assert (status, headers["Content-Type"]) == (200, "image/jpeg")
    assert jpeg == b"\xff\xd8 a picture"
    assert panel.ask("GET", "/camera/none", headers=entered)[0] == 204


def test_it_says_since_when_the_lab_is_lost(panel):
    endpoints, entered = Endpoints(panel.folder), panel.entered()
    uplink = Telling(endpoints, "the lab", lambda: 1000.0)
    try:
        uplink.update("")
        told = json.loads(panel.ask("GET", "/state", headers=entered)[2])["lab"]
        assert told == {"lab": "the lab", "since": 0.0, "why": ""}
        uplink.update("no message from the lab for 0.9 s")
        uplink.update("the lab does not answer at this address")
        told = json.loads(panel.ask("GET", "/state", headers=entered)[2])["lab"]
        assert told == {"lab": "the lab", "since": 1000.0, "why": "the lab does not answer at this address"}
    finally:
        uplink.end()


def test_it_stops_a_run_whoever_holds_the_lease(panel):
    panel.station.ready()
    panel.station.do(lambda: panel.station.session._enter(SessionState.RUNNING, ""))
    panel.station.do(lambda: panel.station.lease.claim("web:ann:p1", 0, 0.0))
    status, _, content = panel.ask("POST", "/stop", {}, panel.entered())
    assert (status, json.loads(content)) == (200, {"done": True, "text": "stopped"})
    assert panel.station.session.state is SessionState.READY
    assert panel.station.commands[-1].user == "panel:127.0.0.1"


@pytest.mark.parametrize(
    "said",
    [
        b"",
        b"GET / HTTP/1.1\r\nHost: local",
        b"POST /estop HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01",
        b"GET " + b"x" * 70_000,
    ],
)
def test_slow_and_odd_clients_keep_nobody_from_the_estop(panel, said):
    odd = [socket.create_connection(("127.0.0.1", panel.port)) for _ in range(70)]
    try:
        for one in odd:
            try:
                one.sendall(said)
            except OSError:  # it was cut off already
                continue
        count, (status, _, _) = presses(panel, lambda: panel.ask("POST", "/estop", {}))
        assert (count, status) == (1, 200)
    finally:
        for one in odd:
            one.close()


def test_clients_that_read_no_pictures_keep_nobody_from_the_estop(panel):
    entered = panel.entered()
    big = b"\xff\xd8" + b"p" * 3_000_000

    def listed():
        panel.station.do(lambda: panel.station._cameras.publish("camera/big", big))
        return "big" in json.loads(panel.ask("GET", "/state", headers=entered)[2])["cameras"]

    eventually(listed, "a large picture")
    lines = [f"GET /camera/big HTTP/1.1\r\nHost: localhost\r\nCookie: {entered['Cookie']}\r\n\r\n"] * 40
    mute = []
    try:
        for line in lines:
            one = socket.create_connection(("127.0.0.1", panel.port))
            one.sendall(line.encode())
            mute.append(one)
        count, (status, _, _) = presses(panel, lambda: panel.ask("POST", "/estop", {}))
        assert (count, status) == (1, 200)
    finally:
        for one in mute:
            one.close()


def test_a_guard_that_does_not_answer_is_told_with_what_to_use(panel):
    panel.station.mute = True
    try:
        status, _, content = panel.ask("POST", "/estop", {})
    finally:
        panel.station.mute = False
    assert status == 502
    assert json.loads(content)["text"].startswith("USE THE HARDWARE STOP: no answer to estop within 1 s")


def test_a_guard_that_says_that_control_did_not_obey_is_no_success(panel):
    panel.station.guard_says = "failed"
    try:
        status, _, content = panel.ask("POST", "/estop", {})
    finally:
        panel.station.guard_says = "done"
    assert (status, json.loads(content)["done"]) == (502, False)
    assert json.loads(content)["text"].startswith("USE THE HARDWARE STOP: ")


def test_guesses_of_the_pin_are_refused_more_and_more_and_the_estop_is_not(panel):
    assert panel.ask("POST", "/pin", {"pin": "000000"})[0] == 403

    def guess():
        status, _, content = panel.ask("POST", "/pin", {"pin": "000000"})
        return status == 429 and b"too many wrong PINs" in content

    eventually(guess, "a guess that is not looked at")
    assert panel.ask("POST", "/estop", {})[0] == 200


@pytest.mark.exhaustive
def test_a_panel_that_is_killed_costs_the_station_nothing_and_is_the_same_when_it_is_back(tmp_path):
    panel = Served(tmp_path)
    try:
        entered = panel.entered()
        panel.kill()
        assert not Endpoints(panel.folder).served("panel")
        assert panel.station._thread.is_alive()
        panel.start()
        assert panel.ask("POST", "/estop", {})[0] == 200
        assert panel.ask("GET", "/state", headers=entered)[0] == 401
        assert panel.ask("GET", "/state", headers=panel.entered())[0] == 200
    finally:
        panel.end()
    with pytest.raises(TransportError, match="is not running here"):
        Endpoints(panel.folder).read("panel")


def test_over_https_it_is_the_same_and_without_it_nothing_is_answered(tmp_path):
    pem = certificate(tmp_path)
    panel = Served(tmp_path / "data", certificate=str(pem), key=str(pem))
    try:
        assert panel.url.startswith("https://127.0.0.1:")
        entered = panel.entered(pem)
        assert entered["Cookie"].startswith("__Host-eva-panel=")
        status, headers, _ = panel.ask("POST", "/pin", {"pin": PIN}, trusts=pem)
        assert status == 200
        for word in ("Secure", "HttpOnly", "SameSite=Strict"):
            assert word in headers["Set-Cookie"]
        own = {"Origin": f"https://localhost:{panel.port}"}
        assert panel.ask("POST", "/estop", {}, own, pem)[0] == 200
        downgraded = {"Origin": f"http://localhost:{panel.port}"}
        assert panel.ask("POST", "/estop", {}, downgraded, pem)[0] == 403
        with pytest.raises((OSError, http.client.HTTPException)):
            panel.ask("POST", "/estop", {})
        # Who connects and does not greet keeps nobody out.
        mute = [socket.create_connection(("127.0.0.1", panel.port)) for _ in range(40)]
        assert panel.ask("POST", "/estop", {}, trusts=pem)[0] == 200
        for one in mute:
            one.close()
    finally:
        panel.end()


@pytest.mark.exhaustive
def test_without_a_pin_the_page_offers_its_estop_alone(tmp_path):
    panel = Served(tmp_path, pin="")
    try:
        assert b'data-pin="unset"' in panel.ask("GET", "/")[2]
        status, _, content = panel.ask("POST", "/pin", {"pin": ""})
        assert (status, json.loads(content)["text"]) == (403, "no PIN is set on the station's computer")
        assert panel.ask("POST", "/estop", {})[0] == 200
    finally:
        panel.end()
