"""The panel's page in a browser, as wide as a phone and as a screen."""

from __future__ import annotations

import json
import os

import cv2
import numpy as np
import pytest

from runtime.core.sentences import fixed
from runtime.ipc.bus import Endpoints
from runtime.ipc.session_state import SessionState
from runtime.link.uplink import Telling
from tests.e2e.lab import CHROMIUM, NO_CHROMIUM, browsing
from tests.processes import eventually
from tests.runtime.clients.panel.served import PIN, Served

pytestmark = [
    pytest.mark.lab,
    pytest.mark.slow,
    pytest.mark.skipif(not os.path.exists(CHROMIUM), reason=NO_CHROMIUM),
]
WIDTHS = {"phone": {"width": 390, "height": 844}, "screen": {"width": 1440, "height": 900}}


@pytest.fixture
def panel(tmp_path):
    made = Served(tmp_path)
    yield made
    made.end()


@pytest.fixture
def browser():
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as running, browsing(running) as made:
        yield made


def picture(number):
    """A JPEG with something to see."""
    drawn = np.full((240, 320, 3), (60, 40 * number % 255, 90), np.uint8)
    cv2.putText(drawn, str(number), (120, 150), cv2.FONT_HERSHEY_SIMPLEX, 3, (255, 255, 255), 5)
    return cv2.imencode(".jpg", drawn)[1].tobytes()


def filmed(panel):
    """Every camera has a new picture."""
    panel.station.do(lambda: setattr(panel.station, "mute", True))  # its own pictures are none
    for number, camera in enumerate(("cam_high", "cam_left_wrist", "cam_right_wrist"), 1):
        panel.station.do(lambda c=camera, n=number: panel.station._cameras.publish(f"camera/{c}", picture(n)))
    panel.station.mute = False


def test_whoever_stands_at_the_robot_sees_it_and_stops_it(panel, browser, tmp_path):
    panel.station.ready()
    reason = fixed("health.of_this_test", "nobody commands the station")
    panel.station.do(lambda: panel.station.session._enter(SessionState.RUNNING, reason))
    Telling(Endpoints(panel.folder), "the lab of building 4").update("no message from the lab for 0.9 s")
    page = browser.new_page(viewport=WIDTHS["phone"])
    faults = []
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("console", lambda line: faults.append(line.text) if "Security Policy" in line.text else None)
    page.goto(panel.url)
    page.screenshot(path=tmp_path / "before.png")
    page.get_by_role("button", name="E-STOP").click()
    page.get_by_text("E-stop: every tick now sends the measured position").wait_for()
    assert [press.user for press in panel.station.pressed] == ["panel:127.0.0.1"]
    page.get_by_label("PIN").fill("000000")
    page.get_by_role("button", name="Show the station").click()
    page.get_by_text("wrong PIN").wait_for()
    page.get_by_label("PIN").fill(PIN)
    page.get_by_role("button", name="Show the station").click()
    page.get_by_text("no link to the lab of building 4 since").wait_for()
    page.get_by_text("nobody commands the station").wait_for()
    for name, size in WIDTHS.items():
        page.set_viewport_size(size)
        eventually(lambda: filmed(panel) or drawn(page), "pictures of three cameras")
        page.screenshot(path=tmp_path / f"{name}.png", full_page=True)
        wide = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
        assert wide == 0, name
        estop = page.get_by_role("button", name="E-STOP").bounding_box()
        assert estop["height"] >= 96
        assert estop["y"] + estop["height"] < size["height"]
    page.get_by_role("button", name="Stop the run").click()
    page.locator("#stopped", has_text="stopped").wait_for()
    assert panel.station.session.state is SessionState.READY
    panel.station.mute = True
    page.get_by_text("No sign of life from the station").wait_for()
    panel.station.mute = False
    page.get_by_text("No sign of life from the station").wait_for(state="hidden")
    panel.kill()
    page.get_by_text("The panel does not answer").wait_for()
    page.get_by_role("button", name="E-STOP").click()
    page.get_by_text("USE THE HARDWARE STOP: the panel does not answer").wait_for()
    assert faults == []


def test_a_page_of_another_origin_presses_nothing(panel, browser, tmp_path):
    page = browser.new_page()
    form = f"""<form method=post action="{panel.url}/estop"><button>win a prize</button></form>
    <script>fetch({json.dumps(panel.url + "/estop")}, {{method: "POST", headers: {{"X-EVA-Panel": "1"}}}})
    .catch(() => document.title = "refused");</script>"""
    evil = "http://evil.example/"
    page.route(evil, lambda route: route.fulfill(body=form, content_type="text/html"))
    page.goto(evil)
    page.wait_for_function("() => document.title === 'refused'")
    with page.expect_response("**/estop") as answer:
        page.get_by_role("button").click()
    assert answer.value.status == 403
    assert panel.station.pressed == []


def drawn(page):
    """Whether three cameras show a picture."""
    return page.evaluate("[...document.images].filter((one) => one.naturalWidth === 320).length") == 3
