"""Collecting in a real browser: a session by keyboard, episodes, a gamepad, the queue, the dataset, another day."""

import json
from contextlib import suppress

import pytest

from tests.e2e.bench_page import BenchPage
from tests.e2e.lab import STATION, TABLET
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.slow
TASK = "put the block on the plate"
# A pad in the page's hand: `held` are its buttons that are down, "" where it is not there.
_PAD = """
window.held = null;
navigator.getGamepads = () => window.held === null ? [null] : [{
  index: 0, id: "test pad", connected: true, mapping: "standard",
  buttons: Array.from({length: 17}, (_, button) => ({pressed: window.held.includes(button)})),
}];
"""
_OTHER_DAY = """
from datetime import timedelta
from evaweb.collect.models import CollectSession
newest = CollectSession.objects.get()
setup = {**newest.setup, "fps": 50.0, "cameras": {**newest.setup["cameras"], "cam_high": {"width": 640, "height": 480}}}
then = newest.opened_at - timedelta(days=3)
CollectSession.objects.create(
    station=newest.station, dataset="older", task="fold", operator=newest.operator, setup=setup,
    opened_at=then, closed_at=then,
)
"""


@pytest.fixture(scope="module")
def demo(patient):
    return patient


class Collector(BenchPage):
    """A person who collects, at a tablet."""

    def said(self, words):
        eventually(lambda: words in self.page.locator("#outcome").inner_text(), f"the page says {words!r}")

    def key(self, key):
        self.page.keyboard.press(key)

    @property
    def collect(self):
        return self.snapshot()["collect"]

    def counts(self):
        uuid = self.page.locator("[data-session-uuid]").get_attribute("data-session-uuid")
        return self.api(f"sessions/{uuid}")["counts"]

    def answered(self):
        """Wait until no press is on its way: the page takes no other meanwhile, and says so."""
        eventually(
            lambda: "pressed …" not in self.page.locator("#outcome").inner_text(), "the press is answered"
        )

    def can_start(self):
        """Wait until an episode can start; armed again where the leader was late on a busy machine."""
        self.answered()

        def can():
            if self.page.locator("#arm[aria-checked=false][aria-disabled=false]").count():
                self.key("a")
            return self.page.locator("#big[aria-disabled=false]").count()

        eventually(can, "an episode can start")

    def record(self):
        """An episode of more than a second, by Enter; returns its uuid."""
        self.can_start()
        self.key("Enter")
        self.reaches("RUNNING")
        eventually(lambda: self.snapshot()["run"]["elapsed"] > 1.5, "it is led")
        uuid = self.collect["episode"]
        self.key("Enter")
        self.closed(uuid)
        return uuid

    def closed(self, uuid):
        self.reaches("READY")
        eventually(lambda: (self.collect["last"] or {}).get("uuid") == uuid, "the episode is on disk")


@pytest.fixture(scope="module")
def ann(browser, demo):
    bench = Collector(browser, demo, "operator", TABLET)
    bench.page.add_init_script(_PAD)
    bench.open(f"/stations/{STATION}/collect/")
    bench.at_rest()
    bench.take_again()
    yield bench
    assert [error for error in bench.errors if "409" not in error] == []  # what is refused is said so
    bench.close()


@pytest.fixture(scope="module")
def collecting(ann):
    """Ann, whose session is open and whose station is set up; nothing is armed."""
    page = ann.page
    ann.key("Shift+T")
    page.keyboard.type(TASK)
    page.fill("#session-target", "5")
    page.locator("[data-collect=open]").click()
    page.locator("[data-session-uuid]").wait_for()
    page.locator(".prompt", has_text=TASK).wait_for()
    page.fill("#seed", "1")
    page.keyboard.press("Enter")
    ann.key("u")
    # The arm switch tells that the page itself knows: READY may be from before, and Enter would cancel the set-up.
    page.locator("#arm[aria-checked=false][aria-disabled=false]").wait_for()
    page.locator("#big[data-gate=run]:not([data-settling])").wait_for()
    return ann


@pytest.mark.story
def test_a_session_is_collected_by_keyboard_processed_meanwhile_and_published(collecting, demo):
    ann, page = collecting, collecting.page
    ann.key("Enter")
    ann.said("Start: arm first")
    assert ann.state() == "READY"
    ann.key("a")
    page.locator("#arm[aria-checked=true]").wait_for()

    first = ann.record()
    ann.key("1")
    page.locator("[data-result=success][aria-pressed=true]").wait_for()
    second = ann.record()
    ann.key("3")
    page.locator("[data-result=fail][aria-pressed=true]").wait_for()
    eventually(lambda: page.locator("#saved").inner_text() == "2", "two are saved")
    # The label is in the snapshot before it is in the database, where the summary comes from: a look a second.
    counted = "1 success · 0 partial · 1 fail"
    eventually(lambda: counted in page.locator("#results").inner_text(), f"the summary says {counted!r}")

    ann.key("a")
    page.locator("#arm[aria-checked=false]").wait_for()
    ann.answered()
    page.locator("#big:not([data-settling])").wait_for()
    ann.key("Enter")  # a start that does not take
    ann.said("Start: arm first")
    ann.key("1")
    ann.said("press again to label the episode before it")
    ann.key("3")
    ann.said("fail: the last start did not take")
    assert ann.collect["last"]["result"] == "fail"

    eventually(
        lambda: (
            page.locator("#last-episode .episode-quality").count() == 1
            and page.locator("#queue-words").inner_text().startswith("4 of 4 done")
        ),
        "both are checked and prepared",
        3 * PATIENCE_S,
    )
    page.locator("#publish-version").select_option("v3.0")
    ann.key("p")
    eventually(lambda: ann.counts()["published"] == 1, "the success is published", 3 * PATIENCE_S)
    dataset = demo.data / "datasets" / "tabletop_demonstrations-simulated"
    lines = [json.loads(line) for line in (dataset / "meta" / "eva_episodes.jsonl").read_text().splitlines()]
    assert [(line["uuid"], line["success"], line["result"]) for line in lines] == [(first, True, "success")]
    assert json.loads((dataset / "meta" / "info.json").read_text())["codebase_version"] == "v3.0"
    told = ann.api(f"episodes/{second}")
    assert (told["kind"], told["task"], told["dataset_index"]) == ("demonstration", TASK, None)


def test_what_went_wrong_is_discarded_and_recorded_again_also_with_a_gamepad(collecting):
    ann, page, before = collecting, collecting.page, collecting.counts()
    page.evaluate("window.held = [0]")  # pressed before anybody looked
    eventually(lambda: "test pad" in page.locator("[data-pad=state]").inner_text(), "the pad is seen")
    page.wait_for_timeout(700)
    assert (ann.state(), ann.collect["episode"]) == ("READY", None)

    looks = "() => new Promise((seen) => requestAnimationFrame(() => requestAnimationFrame(seen)))"

    def push(button):
        for held in ([], [button], []):
            page.evaluate("held => { window.held = held }", held)
            page.evaluate(looks)

    def press(button):
        """Until the page has seen it: one that draws less than twice a second takes nothing for a press."""
        said = page.locator("[data-pad=said]")

        def seen():
            said.evaluate("element => { element.textContent = '' }")
            push(button)
            return said.text_content()

        eventually(seen, f"the page sees button {button}")

    def begin():
        """Start, anew where a page that draws slowly did not look in time, or the arm had fallen."""
        ann.can_start()
        press(0)
        with suppress(AssertionError):
            eventually(
                lambda: ann.collect["episode"], "an episode is open"
            )  # a third of the patience around it
        return ann.collect["episode"]

    begun = eventually(begin, "an episode is open", 3 * PATIENCE_S)
    ann.reaches("RUNNING")
    press(3)
    ann.said("press again")
    assert ann.collect["episode"] == begun

    def recorded_again():
        """Pressed until the page has done it; started where a busy machine was too late for the robot to be at rest."""
        if ann.collect["episode"] == begun:
            press(3)
        elif "not started" in page.locator("#outcome").inner_text():
            begin()
        return ann.collect["episode"] not in (None, begun)

    eventually(recorded_again, "the next episode is open", 3 * PATIENCE_S)
    again = ann.collect["episode"]
    eventually(lambda: ann.snapshot()["run"]["elapsed"] > 1.2, "it is led")

    def stopped():
        if ann.collect["episode"] == again:
            press(0)
        return ann.collect["episode"] is None

    eventually(stopped, "the episode is ended")
    ann.closed(again)

    press(15)
    page.locator("[data-result=partial][aria-pressed=true]").wait_for()

    for other in ("x", "Shift", "m"):  # nothing, nothing yet, another button
        ann.key("d")
        ann.said("press again")
        ann.key(other)
        page.locator("[data-collect=discard]:not([data-asks])").wait_for()
    ann.key("m")
    ann.key("d")
    ann.said("press again")
    press(6)  # which does nothing
    page.locator("[data-collect=discard]:not([data-asks])").wait_for()
    assert not ann.collect["last"]["discarded"]

    def discarded():
        """Pressed until the page has done it."""
        if not ann.collect["last"]["discarded"]:
            ann.key("d")
        return ann.collect["last"]["discarded"]

    eventually(discarded, "the last one is discarded")

    def counted():
        now = ann.counts()
        return (now["saved"] - before["saved"], now["discarded"] - before["discarded"]) == (0, 2)

    eventually(counted, "two more are discarded and none is saved")

    ann.key("m")
    page.locator(".pad-row[data-action=fail] button").click()
    push(5)
    page.locator(".pad-row[data-action=fail] .pad-button", has_text="RB (5)").wait_for()
    page.evaluate("window.held = null")
    ann.key("m")


def test_another_day_the_session_goes_on_and_one_of_another_set_up_is_refused(collecting, demo):
    ann, page = collecting, collecting.page
    mine = page.locator("[data-session-uuid]").get_attribute("data-session-uuid")
    ann.key("Shift+C")
    page.locator("#open-session").wait_for()
    demo.python(_OTHER_DAY)
    page.reload()
    ann.at_rest()
    ann.take_again()
    page.locator("#session-earlier").select_option(index=1)
    page.locator("[data-collect=resume]").click()
    ann.said("Resume refused")
    said = page.locator("#outcome").inner_text()
    assert "fps = 30, allowed 50" in said
    assert "camera cam_high = 400x300, allowed 640x480" in said
    page.locator("#session-earlier").select_option(mine)
    ann.key("Shift+O")
    page.locator(f"[data-session-uuid='{mine}']").wait_for()
    kinds = [event["kind"] for event in ann.api(f"sessions/{mine}")["events"]]
    assert [kind for kind in kinds if kind != "published"] == ["opened", "closed", "resumed"]
    page.locator("[data-open-keys]").dispatch_event("click")
    shown = page.locator("#keys-list").inner_text()
    assert "Start; stop and save" in shown
    assert "E-stop, outside text fields" not in shown
