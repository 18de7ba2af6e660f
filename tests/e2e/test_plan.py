"""Trials of a blind plan in a real browser: cameras confirmed, handed out, given back, ticked live, scored, next."""

import re

import pytest

from tests.e2e.bench_page import BenchPage
from tests.e2e.lab import STATION, WIDE
from tests.e2e.planned import handed, saved, shown, stopped
from tests.processes import eventually

pytestmark = [
    pytest.mark.slow,
]
PLAN = "block-on-plate-blind"
TELLING = re.compile(r"pick-place-\d+k-evaluated|ws://|latency|delay_steps", re.IGNORECASE)


@pytest.fixture(scope="module")
def operator(browser, patient):
    bench = BenchPage(browser, patient, "operator", WIDE)
    bench.said = []  # every text and frame that the live socket sent
    bench.page.on(
        "websocket", lambda socket: socket.on("framereceived", lambda frame: bench.said.append(frame))
    )
    bench.open(f"/stations/{STATION}/eval/")
    yield bench
    assert bench.errors == []
    bench.close()


def started(operator):
    """The next trial is handed out, set up, and runs."""
    handed(operator)
    operator.press("run")
    operator.reaches("RUNNING")
    operator.page.locator("#live input[name=milestone]").first.wait_for()
    return shown(operator)


def scored(operator, ticks, failure=()):
    """The run is stopped, and what is ticked is saved, with what is pressed of its failure."""
    stopped(operator)
    saved(operator, ticks, failure)


def drawn(operator):
    """A region is drawn on the position's reference, and the panel says how the bench lies in it."""
    page = operator.page
    page.locator("[data-take-reference]").click()
    with page.context.expect_page() as opened:
        page.locator("#panel a[href^='/references/']", has_text="cam_high").click()
    drawing = opened.value
    picture = drawing.locator("#drawing img")
    picture.click(trial=True)
    box = picture.bounding_box()
    left, top = box["x"], box["y"]
    drawing.mouse.move(left + 0.2 * box["width"], top + 0.3 * box["height"])
    drawing.mouse.down()
    drawing.mouse.move(left + 0.7 * box["width"], top + 0.8 * box["height"], steps=4)
    drawing.mouse.up()
    drawing.keyboard.type("bench")  # its name is chosen, to be typed over
    drawing.locator("[data-of=x]").fill("25")
    with drawing.expect_navigation():
        drawing.locator("#save-regions").click()
    assert drawing.locator("[data-of=name]").input_value() == "bench"
    assert drawing.locator("[data-of=x]").input_value() == "25.0"
    drawing.close()
    page.locator("#aid-regions li", has_text="cam_high, bench").wait_for()
    page.locator("[data-camera=cam_high] canvas.region-over").wait_for()


@pytest.mark.story
def test_trials_of_a_blind_plan_are_made_through_the_tab(operator, patient):
    page = operator.page
    operator.at_rest()
    operator.take_again()
    offered = set(page.locator("#checkpoint-choice option").all_inner_texts())
    assert {"pick-place-40k", "pick-place-8k"} <= offered
    assert not any(name.endswith("-evaluated") for name in offered)
    page.select_option("#plan-choice", PLAN)
    blocked = page.locator("[data-next][aria-disabled=true]")
    blocked.wait_for()
    eventually(
        lambda: "confirm the cameras first" in blocked.get_attribute("title"),
        "it is said what is missing",
    )
    page.locator("[data-confirm-cameras]").click()
    first = started(operator)
    page.locator("body[data-veiled]").wait_for()
    eventually(lambda: page.locator("[data-reveals]").count() == 0, "what tells is gone")
    page.keyboard.press("1")
    eventually(lambda: page.locator("#live input[name=milestone]").first.is_checked(), "it is ticked")
    eventually(lambda: "at " in page.locator("#live [data-at]").first.inner_text(), "the tick has its time")
    scored(operator, ticks=(1, 2), failure=("Shift+G", "Shift+D"))
    outcomes = operator.api("trials?limit=1")["items"][0]
    assert (outcomes["failure_phase"], outcomes["failure"]) == ("grasp", "dropped")
    assert (outcomes["code"], outcomes["checkpoint"], outcomes["success"]) == (first, first, False)
    reached = operator.api(f"trials/{outcomes['id']}")["scores"][0]["milestones"]
    assert [one["reached"] for one in reached] == [True, True, False, False]
    assert reached[0]["at_s"] is not None
    assert reached[1]["at_s"] is None

    second = handed(operator)
    assert second != first
    drawn(operator)
    page.locator("summary", has_text="Return this trial unrun").click()
    page.fill("#return-why", "the block fell off the table")
    page.locator("[data-return]").click()
    page.locator("[data-next]").wait_for()
    third = started(operator)
    assert third not in (first, second)
    page.locator(".plan-trial", has_text="attempt 2").wait_for()
    scored(operator, ticks=(1,))
    page.locator(".plan-progress", has_text="2 of 24").wait_for()

    frames = "".join(one if isinstance(one, str) else one.decode("utf-8", "replace") for one in operator.said)
    assert '"veiled"' in frames
    assert "-evaluated" not in frames
    assert not TELLING.search(page.content())
    page.goto(f"{patient.url}/result/trials/{outcomes['id']}/")
    assert first in page.locator("h1").inner_text()
    assert not TELLING.search(page.locator("main").inner_text())
