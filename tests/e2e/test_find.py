"""Find anything, and what lists and home say, in a real browser: at a station, on a phone, by keys alone."""

import time

import pytest

from tests.e2e.bench_page import BenchPage
from tests.e2e.lab import STATION, WIDE
from tests.processes import eventually
from tests.runtime.quality import built

pytestmark = pytest.mark.slow
PHONE = {"width": 390, "height": 844}
MOVING = ("Home: ", "Set up:", "Stop: ", "Pause: ", "Hand: x", "Arm", "Next chunk", "Send the robot")


@pytest.fixture
def ann(browser, patient):
    page = BenchPage(browser, patient, "ann", WIDE)
    yield page
    assert page.errors == []
    page.close()


def options(page):
    return page.locator("#find-list [role=option]")


def asked(page, words):
    """Type it, and wait until the list is that of these words."""
    page.fill("#find-words", words)
    options(page).filter(has_text=f"Episodes with “{words}”").wait_for()


def test_it_finds_by_keys_and_presses_what_the_page_itself_would(ann):
    page, keys = ann.page, ann.page.keyboard
    ann.open(f"/stations/{STATION}/debug/")
    ann.at_rest()
    keys.press("Control+k")
    asked(page, "show the newest chunk")
    command = options(page).filter(has_text="Show the newest chunk").first
    was = page.locator("[data-toggle=chunk]").get_attribute("aria-pressed")
    command.click()
    assert page.locator("[data-toggle=chunk]").get_attribute("aria-pressed") != was

    for words in ("home: drive", "set up", "run", "stop", "arm", "hand:"):
        keys.press("Control+k")
        asked(page, words)
        moving = [text for text in options(page).all_inner_texts() if text.startswith(MOVING)]
        assert moving == []
        keys.press("Escape")
        page.locator("#find").wait_for(state="hidden")
    ann.at_rest()  # no Esc was an e-stop

    keys.press("?")
    listed = page.locator("#keys-list")
    listed.wait_for()
    assert "Find anything" in listed.inner_text()
    refused = listed.locator("dd[data-refused]").filter(has_text="Home: drive to the start pose")
    assert " – " in refused.inner_text()  # and why
    keys.press("Escape")

    keys.press("Control+k")
    keys.type("replay")
    keys.press("Enter")  # before the answer is there
    page.wait_for_url("**/replay/")


def test_a_list_is_filtered_sorted_and_reviewed_at_once(ann, patient):
    root = patient.data / "episodes"
    made = [
        built.record_of(root, "agilex_piper", started_wall=time.time() - 60 * back, station=STATION).name
        for back in (1, 2)
    ]
    patient.python("from evaweb.episodes.reconcile import reconcile; reconcile()")
    page = ann.open("/replay/").page
    page.select_option("select[name=review]", "unreviewed")
    page.locator(".filter-chip").wait_for()
    assert page.url.endswith("?review=unreviewed")
    late = []
    page.route("**/site/lists*.js", lambda route: late.append(route))
    page.locator("thead").get_by_role("link", name="Time", exact=True).click()
    page.locator("[aria-sort=descending]").wait_for()
    assert "review=unreviewed" in page.url
    for uuid in made:
        page.check(f"[data-tick][value='{uuid}']")
    late[0].continue_()  # what was ticked while the page was still loading is ticked
    page.unroute("**/site/lists*.js")
    bulk = page.locator("[data-bulk]")
    bulk.get_by_label("Tag", exact=True).fill("Slips")
    bulk.get_by_role("button", name="Add tag").click()
    page.locator("[data-bulk-said]:text('2 of 2 done')").wait_for()
    page.locator(f"[data-episode='{made[0]}'] .tags", has_text="slips").wait_for()
    bulk.get_by_role("button", name="Undo").click()
    page.locator("[data-bulk-said]:text('Undo: 2 of 2 done')").wait_for()
    page.locator(".tags").first.wait_for(state="detached")
    bulk.get_by_role("button", name="Pass").click()
    bulk.get_by_role("button", name="Cancel").click()
    assert {ann.api(f"episodes/{uuid}/reviews")["verdict"] for uuid in made} == {None}
    bulk.get_by_role("button", name="Pass", exact=True).click()
    bulk.get_by_role("button", name="Pass 2 episodes").click()
    page.locator("[data-bulk-said]:text('Pass: 2 of 2 done')").wait_for()
    page.locator(f"[data-episode='{made[0]}']").wait_for(state="detached")
    assert {ann.api(f"episodes/{uuid}/reviews")["verdict"]["verdict"] for uuid in made} == {"pass"}
    page.get_by_role("link", name="Remove the filter").click()
    page.locator(f"[data-episode='{made[0]}'] [data-verdict=pass]").wait_for()


def test_a_phone_finds_and_home_fits_it(browser, patient):
    ann = BenchPage(browser, patient, "ann", PHONE, has_touch=True, color_scheme="light")
    page = ann.page
    page.locator(f"#still-{STATION}:visible").wait_for()
    assert page.locator("html").get_attribute("data-theme") == "light"
    assert page.evaluate("document.documentElement.scrollWidth") == PHONE["width"]
    page.tap("[data-open-find]")
    asked(page, STATION)
    options(page).filter(has_text=STATION).first.tap()
    page.wait_for_url(f"**/stations/{STATION}/eval/")
    assert page.locator("html").get_attribute("data-theme") == "dark"
    page.locator(".bar-user summary").tap()
    page.get_by_label("Light").check()
    eventually(
        lambda: page.locator("html").get_attribute("data-theme") == "light", "it is light at the bench"
    )
    assert ann.errors == []
    ann.close()
