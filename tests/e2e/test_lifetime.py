"""Who gets into a lab and who does not; how it ends, and what the next one on the same data has."""

import json
import signal
import subprocess
import sys

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from evaweb.lab.rest_client import RestClient
from tests.e2e.lab import ROOT, STATION, left
from tests.e2e.remote import page_of, refusal, reset_station, visitor
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def demo(shared):
    return shared


def dial(demo, origin, cookies=""):
    """The live socket of a page from somewhere else."""
    url = demo.url.replace("http", "ws", 1) + f"/ws/stations/{STATION}?page=p1"
    headers = {"Cookie": cookies} if cookies else {}
    return connect(url, origin=origin, additional_headers=headers, proxy=None)


def test_a_wrong_password_opens_nothing(demo):
    assert "name or password is wrong" in refusal(lambda: visitor(demo, "operator", "guessed"))


def test_who_has_not_logged_in_is_asked_to(demo):
    assert "HTTP 401" in refusal(lambda: RestClient(demo.url).get("stations"))
    with dial(demo, demo.url) as socket, pytest.raises(ConnectionClosed) as closed:
        socket.recv(20)
    assert closed.value.rcvd.code == 4401


def test_a_page_of_another_site_does_not_get_the_live_socket(demo):
    cookies = visitor(demo, "operator").cookies
    with pytest.raises(InvalidStatus) as refused, dial(demo, "http://elsewhere.example", cookies):
        pass
    assert refused.value.response.status_code == 403
    with dial(demo, demo.url, cookies) as socket:
        assert json.loads(socket.recv(20))["type"] == "hello"


def test_a_viewer_watches_and_commands_nothing(demo):
    watching = visitor(demo, "visitor")
    with page_of(watching) as page:
        page.wait(lambda state: state["state"] != "disconnected", PATIENCE_S, "the station")
        for ask in (page.claim, lambda: page.press("setup"), page.prepare, lambda: page.press("release")):
            sentence = refusal(ask)
            assert "HTTP 403" in sentence
            assert "visitor is a viewer" in sentence
        page.draws(5)


def test_a_second_lab_on_the_same_data_is_refused_and_the_first_goes_on(demo):
    second = subprocess.run(
        [sys.executable, "manage.py", "demo", "--port", "0"],
        cwd=ROOT,
        env=demo.environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert second.returncode != 0
    assert f"process {demo.child.pid}" in second.stderr
    assert "EVA_DATA_DIR" in second.stderr
    assert "Traceback" not in second.stderr
    assert visitor(demo, "operator").get("me")["username"] == "operator"


@pytest.mark.story
def test_ctrl_c_ends_everything_and_a_second_start_keeps_trials_under_new_passwords(demo):
    operator = visitor(demo, "operator")
    with page_of(operator) as page:
        page.wait(lambda state: state["state"] != "disconnected", PATIENCE_S, "the station")
        first = page.prepare()
    operator.post(f"trials/{first}/abandon", {"reason": "the lab is closed"})
    everyone, old = demo.everyone(), demo.passwords["operator"]
    assert len(everyone) > len(demo.pids)
    assert demo.end(signal.SIGINT) == 0
    assert left(everyone) == []

    demo.start()
    assert demo.passwords["operator"] != old
    assert "wrong" in refusal(lambda: visitor(demo, "operator", old))
    operator = visitor(demo, "operator")
    kept = operator.get(f"trials/{first}")
    assert (kept["status"], kept["reason"]) == ("abandoned", "the lab is closed (operator)")
    with page_of(operator) as page:
        page.wait(lambda state: state["state"] != "disconnected", PATIENCE_S, "the station")
        assert page.prepare() == first + 1
    reset_station(visitor(demo, "admin"))


@pytest.mark.story
def test_the_end_of_all_follows_from_the_kill_of_the_supervisor(demo):
    everyone = demo.everyone()
    assert len(everyone) > len(demo.pids)
    assert demo.end(signal.SIGKILL) == -signal.SIGKILL
    eventually(lambda: not left(everyone), "all processes have ended")
