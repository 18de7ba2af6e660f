"""A lab behind a proxy that ends TLS, as docs/administrator.md has it: login, live page, lease, presses both ways."""

import json

import pytest

from runtime.ipc.estop_latch import Latch
from tests.e2e.bench_page import BenchPage
from tests.e2e.conftest import LOCKSTEP
from tests.e2e.lab import STATION, WIDE, Demo
from tests.e2e.test_faults import suspended
from tests.e2e.tls_proxy import NAME, https
from tests.processes import eventually

pytestmark = pytest.mark.slow
AREA = "#estop-area"


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    folder = tmp_path_factory.mktemp("https")
    behind = {"EVA_HTTPS": "1", "EVA_PROXIES": "127.0.0.1", "EVA_ALLOWED_HOSTS": f"{NAME},127.0.0.1"}
    demo = Demo(folder, *LOCKSTEP, **behind).start()
    ports = json.loads((demo.data / "stops.json").read_text())
    with https(folder, ports["web_port"], ports["port"]) as demo.url:
        yield demo
    assert demo.end() == 0, (folder / "demo.log").read_text()[-2000:]


@pytest.fixture(scope="module")
def window(browser, lab):
    """The operator's browser, who has logged in."""
    window = BenchPage(browser, lab, "operator", WIDE)
    yield window
    window.close()


@pytest.fixture
def page(window):
    """The page, loaded anew."""
    window.errors.clear()
    window.open(f"/stations/{STATION}/eval/")
    window.at_rest()
    window.page.locator(f"{AREA}[data-second-way]").wait_for()
    return window


def released(lab, page):
    """Nothing is latched: pressed and released by this page."""
    if Latch(lab.data / "stations" / STATION).read() is not None:
        page.press("release")
    page.at_rest()


@pytest.mark.story
def test_what_a_browser_keeps_goes_over_https_alone_and_pages_press_at_their_own_address(lab, page):
    cookies = {cookie["name"]: cookie for cookie in page.context.cookies()}
    assert sorted(name.rpartition("_")[0] for name in cookies) == ["eva_csrf", "eva_session"]
    assert all(cookie["secure"] for cookie in cookies.values())
    said = page.page.request.get(f"{lab.url}/stations/{STATION}/eval/").headers
    assert said["strict-transport-security"].startswith("max-age=")
    policy = dict(part.strip().partition(" ")[::2] for part in said["content-security-policy"].split(";"))
    assert policy["connect-src"] == "'self'"
    assert page.page.get_attribute(AREA, "data-stops") == ""
    assert page.errors == []


def test_the_log_has_the_address_of_the_person_and_not_of_the_proxy(lab, page):
    log = lab.data / "logs" / "web.log"
    eventually(lambda: "'operator' has logged in from 192.0.2.7" in log.read_text(), "the log has the login")


@pytest.mark.story
def test_a_command_and_a_press_go_through_it(lab, page):
    page.take_again()
    page.page.click("#estop")
    page.page.locator(f"{AREA}[data-kind=stopped]").wait_for()
    page.reaches("FAULTED")
    assert Latch(lab.data / "stations" / STATION).read() is not None
    released(lab, page)
    assert page.errors == []


def test_a_press_goes_through_it_while_the_web_stands_still(lab, page):
    page.take_again()
    with suspended(lab.pid("serve")):
        page.page.click("#estop")
        page.page.locator(f"{AREA}[data-kind=stopped]").wait_for()
        assert Latch(lab.data / "stations" / STATION).read() is not None
    page.reaches("FAULTED")
    released(lab, page)


def test_a_press_goes_through_it_while_the_process_for_stops_stands_still(lab, page):
    page.take_again()
    with suspended(lab.pid("stops")):
        page.page.click("#estop")
        page.page.locator(f"{AREA}[data-kind=stopped]").wait_for()
        assert Latch(lab.data / "stations" / STATION).read() is not None
    page.reaches("FAULTED")
    released(lab, page)
