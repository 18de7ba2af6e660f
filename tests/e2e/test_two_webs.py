"""Two web processes behind a proxy that keeps nobody at one of them: whatever a page does is the other's as well."""

import os
import signal
from contextlib import closing
from urllib.error import HTTPError
from urllib.parse import urlencode
from urllib.request import Request

import pytest

from evaweb.lab.rest_client import RestClient
from tests.e2e.lab import STATION
from tests.e2e.remote import opened, page_of, refusal, reset_station
from tests.e2e.two_webs import in_turn, second_web
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.slow
LEASES = "SELECT holder, ended_at IS NULL FROM stations_lease WHERE epoch = ?"
COMMANDS = "SELECT count(*), count(DISTINCT uuid) FROM stations_command WHERE kind = ?"


class Behind:
    """The lab as it is reached through the proxy."""

    def __init__(self, demo, proxy, url, second):
        self.demo, self.proxy, self.url, self.second = demo, proxy, url, second
        self.passwords = demo.passwords

    def visitor(self, username):
        found = RestClient(self.url)
        found.login(username, self.passwords[username])
        return found


@pytest.fixture(scope="module")
def lab(patient):
    with second_web(patient) as (second, port), in_turn(patient.url, port) as (proxy, url):
        yield Behind(patient, proxy, url, second)


@pytest.fixture(scope="module")
def admin(lab):
    return lab.visitor("admin")


@pytest.fixture
def bench(lab, admin):
    """A page of an operator that has the station."""
    reset_station(admin)
    with page_of(lab.visitor("operator")) as page:
        page.take()
        yield page
    reset_station(admin)


def test_a_trial_is_run_watched_stopped_and_scored_though_each_request_meets_another_process(lab, bench):
    served = dict(lab.proxy.served)
    trial = bench.running()
    with page_of(lab.visitor("visitor")) as watching:
        watching.wait(lambda state: state["state"] == "running", PATIENCE_S, "the run is seen")
        assert watching.state()["lease"]["epoch"] == bench.epoch
        assert "HTTP 403" in refusal(lambda: watching.press("stop"))
    bench.stop(trial)
    bench.score(trial)
    told = len(bench.renewals())
    eventually(lambda: len(bench.renewals()) > told, "its lease is renewed further on")
    assert all(said["ok"] for said in bench.renewals())
    assert all(lab.proxy.served[port] > served[port] for port in lab.proxy.ports), lab.proxy.served
    total, different = lab.demo.rows(COMMANDS, "run")[0]
    assert total == different >= 1
    assert bench.status(trial) == "scored"


@pytest.mark.parametrize("way", ["socket", "request"])
def test_an_estop_by_either_way_is_seen_by_pages_of_both_processes(lab, bench, way):
    with page_of(lab.visitor("ann")) as one, page_of(lab.visitor("visitor")) as other:
        if way == "socket":
            assert other.estop("a hand in the way")["status"] == "done"
        else:
            address = f"stations/{STATION}/estop"
            assert one.visitor.post(address, {"why": "a hand in the way"})["status"] == "done"
        for page in (bench, one, other):
            page.wait(lambda state: state["estop"], PATIENCE_S, "the e-stop is shown")
    bench.command("release")
    bench.wait(lambda state: state["state"] == "idle", PATIENCE_S, "released")


def test_a_station_is_asked_for_and_handed_over_between_pages_of_two_processes(lab, bench):
    with page_of(lab.visitor("ann")) as ann:
        lease = f"stations/{STATION}/lease"
        assert "has bench-1" in refusal(lambda: ann.claim())
        asked = ann.visitor.post(lease, {"action": "request", "page": ann.page})["requests"][0]["id"]
        given = {"action": "hand_over", "page": bench.page, "request": asked}
        ann.epoch = bench.visitor.post(lease, given)["epoch"]
        bench.epoch = 0
        ann.wait(lambda state: state["lease"]["epoch"] == ann.epoch, PATIENCE_S, "ann has the station")
        assert ann.renewed()
        ((holder, is_open),) = lab.demo.rows(LEASES, ann.epoch)
        assert (holder, is_open) == (f"web:ann:{ann.page}", 1)


def test_who_logs_out_at_one_process_is_nobody_at_the_other(lab):
    ann = lab.visitor("ann")
    for _ in lab.proxy.ports:
        ann.get("stations")
    kept = ann.cookies
    form = {"csrfmiddlewaretoken": ann.csrf_token}
    headers = {"Referer": lab.url, "Cookie": kept, "X-CSRFToken": ann.csrf_token}
    with pytest.raises(HTTPError, match="302"):
        ann._opener.open(Request(f"{lab.url}/logout/", urlencode(form).encode(), headers)).close()
    for _ in lab.proxy.ports:
        assert "HTTP 401" in refusal(lambda: ann.get("stations"))


def test_a_page_whose_process_is_killed_goes_on_at_the_other_with_its_lease(lab, bench):
    trial = bench.running()
    os.kill(lab.second.pid, signal.SIGKILL)
    lab.second.wait(PATIENCE_S)
    with closing(opened(lab.visitor("operator"), bench.page)) as again:
        again.epoch = bench.epoch
        bench.epoch = 0
        assert again.renewed()
        again.goes_on(trial)
        again.stop(trial)
        again.score(trial)
        bench.epoch = again.epoch
        again.epoch = 0
