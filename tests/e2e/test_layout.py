"""On pages of a station nothing laps over anything else, and no word is cut off, at the sizes of a lab's screens."""

from pathlib import Path

import pytest

from tests.e2e.bench_page import BenchPage
from tests.e2e.lab import STATION, TABLET, WIDE
from tests.e2e.remote import reset_station, visitor

pytestmark = pytest.mark.slow
SIZES = [WIDE, {"width": 1280, "height": 800}, TABLET, {"width": 820, "height": 1180}]
TABS = ["eval", "debug", "collect"]
FAULTS = (Path(__file__).parent / "layout_faults.js").read_text("utf-8")
# What lies on top at three places of the e-stop's button, as far as these are on the screen and not only on the page.
ON_TOP = """() => {
  const { left, right, top, bottom } = document.getElementById("estop").getBoundingClientRect();
  const seen = (y) => right <= visualViewport.width && y < visualViewport.height;
  return [0.1, 0.5, 0.9].map((part) => top + (bottom - top) * part)
    .map((y) => seen(y) && document.elementFromPoint((left + right) / 2, y).id);
}"""
NOBODY_ANSWERED = """() => {
  document.getElementById("estop-area").dataset.kind = "failed";
  const note = document.getElementById("estop-note");
  note.innerHTML = "USE THE HARDWARE STOP <span class=estop-detail></span>";
  note.lastChild.textContent = "no answer from the web server within 2.5 s. ".repeat(4);
}"""
FAULTY = """
<style>
  body { margin: 0; font: 16px/20px monospace }
  div { position: relative; width: 200px; height: 40px }
  .over span { position: absolute; left: 0 }
  .short { width: 60px; overflow: hidden; white-space: nowrap }
  .meant { text-overflow: ellipsis }
  .scrolls { overflow: auto; white-space: nowrap; width: 60px }
  .layer { position: fixed; top: 0; left: 0; width: 90px; height: 30px; background: #fff }
  .low { position: fixed; margin: 0; bottom: -12px; left: 300px; height: 20px; background: #fff }
</style>
<div>under the layer</div>
<p class="layer">the layer</p>
<div class="over"><span>one</span><span>two</span></div>
<div class="short">cut in its middle</div>
<div class="short meant">cut with an ellipsis</div>
<div class="scrolls">scrolled to by whoever wants</div>
<p class="low">below the window</p>
"""


def test_what_laps_over_or_is_cut_off_is_found_and_what_is_meant_is_not(browser):
    page = browser.new_page(viewport={"width": 600, "height": 400})
    page.set_content(FAULTY)
    found = page.evaluate(FAULTS)
    page.close()
    assert found == [
        "'cut in its middle' is cut off",
        "'below the window' is cut off",
        "'one' laps over 'two'",
    ]


def faults(page):
    """What is wrong with it at each size."""
    found = {}
    for size in SIZES:
        page.page.set_viewport_size(size)
        page.page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        found[tuple(size.values())] = page.page.evaluate(FAULTS)
    return {size: said for size, said in found.items() if said}


@pytest.fixture(scope="module")
def admin(patient):
    return visitor(patient, "admin")


@pytest.fixture(scope="module")
def page(browser, patient):
    page = BenchPage(browser, patient, "ann", WIDE)
    yield page
    page.close()


@pytest.mark.parametrize("tab", TABS)
def test_a_page_of_a_station_is_whole_at_every_size_also_while_its_e_stop_is_latched(page, admin, tab):
    reset_station(admin)
    page.page.set_viewport_size(WIDE)
    page.open(f"/stations/{STATION}/{tab}/").at_rest()
    page.cameras_live()
    page.page.locator("#curves-marks .legend").first.wait_for()
    assert faults(page) == {}
    page.page.click("#estop")
    page.reaches("FAULTED")
    page.page.locator("#situation").wait_for()
    assert faults(page) == {}
    reset_station(admin)


@pytest.mark.parametrize(
    ("width", "height", "phone"), [(390, 844, True), (320, 640, True), (512, 300, False)]
)
def test_the_e_stop_is_on_every_screen_and_can_be_pressed_again(browser, patient, width, height, phone):
    size = {"width": width, "height": height}
    page = BenchPage(browser, patient, "ann", size, is_mobile=phone, has_touch=phone)
    page.open(f"/stations/{STATION}/debug/").at_rest()
    assert page.page.evaluate(ON_TOP) == ["estop"] * 3
    page.page.evaluate(NOBODY_ANSWERED)
    assert page.page.evaluate(ON_TOP) == ["estop"] * 3
    page.close()
