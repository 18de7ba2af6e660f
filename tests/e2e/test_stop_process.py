"""A press on a page in a real browser arrives by one way while the other one is gone."""

import json
import os
import signal
from uuid import UUID, uuid4

import pytest

from runtime.ipc.estop_latch import Latch
from tests.e2e.bench_page import BenchPage
from tests.e2e.lab import STATION, WIDE
from tests.e2e.remote import reset_station, visitor
from tests.e2e.test_faults import suspended
from tests.processes import PATIENCE_S, alive, eventually

pytestmark = pytest.mark.slow
AREA = "#estop-area"
PRESSES = "SELECT uuid, status FROM stations_command WHERE kind = 'estop'"
ANSWERS = """
async () => {
  const { stops, address } = document.getElementById("estop-area").dataset;
  return fetch(stops + address, { credentials: "include" }).then((answer) => answer.ok, () => false);
}
"""
ALONE = """
async (uuid) => {
  const { stops, address } = document.getElementById("estop-area").dataset;
  const body = JSON.stringify({ uuid, why: "pressed by a test" });
  return fetch(stops + address, { method: "POST", credentials: "include", body }).then((answer) => answer.json());
}
"""
COUNTED = "SELECT uuid, json_extract(data, '$.times') FROM stations_command WHERE kind = 'estop'"
ENDED = """
from django.contrib.sessions.models import Session
from django.utils import timezone
for session in Session.objects.all():
    if session.get_decoded().get("_auth_user_id") == str({user}):
        Session.objects.filter(pk=session.pk).update(expire_date=timezone.now())
"""


@pytest.fixture(scope="module")
def demo(shared):
    return shared


@pytest.fixture(scope="module")
def admin(demo):
    return visitor(demo, "admin")


@pytest.fixture(scope="module")
def window(browser, demo):
    """The browser of a viewer who has logged in."""
    window = BenchPage(browser, demo, "visitor", WIDE)
    yield window
    window.close()


@pytest.fixture
def page(window, admin):
    """The page of somebody who has the station's e-stop before them, both ways to which stand; loaded anew."""
    window.errors.clear()
    window.open(f"/stations/{STATION}/eval/")
    window.at_rest()
    window.page.locator(f"{AREA}[data-second-way]").wait_for()
    yield window
    reset_station(admin)


def latched(demo):
    return Latch(demo.data / "stations" / STATION).read()


def foreseen(demo):
    """How many presses are on the disk and not yet in the database."""
    files = [path for path in (demo.data / "unwritten").iterdir() if path.suffix in (".json", ".lines")]
    return sum(
        len(path.read_text().splitlines()) if path.suffix == ".lines" else times(json.loads(path.read_text()))
        for path in files
    )


def times(document):
    return document["data"].get("times", 1)


def written(demo, before):
    """How many presses the rows stand for that were not there before."""
    known = {uuid for uuid, _ in before}
    return sum(count or 1 for uuid, count in demo.rows(COUNTED) if uuid not in known)


def pressed(demo, page):
    """Press the button; it is acknowledged, and the station is latched."""
    assert latched(demo) is None
    page.page.click("#estop")
    page.page.locator(f"{AREA}[data-kind=stopped]").wait_for()
    assert latched(demo) is not None


@pytest.mark.story
def test_a_press_arrives_while_the_web_stands_still_and_is_written_down_once(demo, page):
    before = set(demo.rows(PRESSES))
    with suspended(demo.pid("serve")):
        pressed(demo, page)
    page.reaches("FAULTED")
    eventually(lambda: set(demo.rows(PRESSES)) - before, "the press is written down")
    eventually(lambda: not list((demo.data / "unwritten").iterdir()), "nothing waits to be written")
    assert [status for _, status in set(demo.rows(PRESSES)) - before] == ["done"]
    assert page.errors == []


@pytest.mark.story
def test_a_press_arrives_while_the_process_for_stops_is_gone_and_pages_know_its_port_all_along(demo, page):
    said = page.page.get_attribute(AREA, "data-stops")
    with suspended(demo.child.pid):
        gone = demo.pid("stops")
        os.kill(gone, signal.SIGKILL)
        eventually(lambda: not alive(gone), "it has ended")
        pressed(demo, page)
        page.page.reload()
        assert page.page.get_attribute(AREA, "data-stops") == said
    eventually(
        lambda: page.page.evaluate(ANSWERS), "the lab has started it again where it was", 3 * PATIENCE_S
    )
    assert demo.pid("stops") != gone
    page.page.reload()
    page.page.locator(f"{AREA}[data-second-way]").wait_for()


def test_a_press_arrives_after_the_web_was_killed_and_before_it_is_there_again(demo, page):
    with suspended(demo.child.pid):
        gone = demo.pid("serve")
        os.kill(gone, signal.SIGKILL)
        eventually(lambda: not alive(gone), "it has ended")
        pressed(demo, page)
    page.reaches("FAULTED")  # over the web, which the lab has started again where it was


def test_presses_of_one_second_are_written_down_though_the_process_for_stops_is_killed_while_the_database_is_locked(
    demo, page
):
    before = set(demo.rows(PRESSES))
    with suspended(demo.pid("serve")), demo.locked():
        sent = [page.page.evaluate(ALONE, str(uuid4())) for _ in range(3)]
        eventually(lambda: foreseen(demo) == len(sent), "all are on the disk")
        os.kill(demo.pid("stops"), signal.SIGKILL)
    answered = {UUID(one["uuid"]) for one in sent if one["status"] == "done"}
    assert len(answered) == len(sent)
    eventually(lambda: written(demo, before) == len(sent), "all presses are in the record", 3 * PATIENCE_S)
    eventually(
        lambda: page.page.evaluate(ANSWERS), "the lab has started it again where it was", 3 * PATIENCE_S
    )


def test_a_page_whose_session_has_ended_still_presses(demo, page):
    demo.python(ENDED.format(user=demo.rows("SELECT id FROM auth_user WHERE username = 'visitor'")[0][0]))
    page.reaches("LOGGED OUT")
    pressed(demo, page)
    page.log_in("visitor")  # the window is that of other tests too
