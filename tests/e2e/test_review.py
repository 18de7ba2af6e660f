"""The review of recorded episodes in a real browser, by keyboard alone: flags, verdicts, annotations, the next one."""

import json
import time

import numpy as np
import pytest

from tests.e2e.bench_page import BenchPage
from tests.e2e.lab import WIDE
from tests.processes import eventually
from tests.runtime.quality import built

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]
ROBOT = "agilex_piper"


@pytest.fixture(scope="module")
def brought(patient):
    """Two episodes on the disk of the lab, one after the other, the newer one with a black camera; both checked."""
    now = time.time()
    black = built.shown(range(40, 60), lambda index: np.zeros((built.HEIGHT, built.WIDTH, 3), np.uint8))
    root = patient.data / "episodes"
    newer = built.record_of(root, ROBOT, black, started_wall=now, station="bench-1").name
    older = built.record_of(root, ROBOT, started_wall=now - 1, station="bench-1").name
    patient.python("from evaweb.episodes.reconcile import reconcile; reconcile()")
    return newer, older


@pytest.fixture
def reviewer(browser, patient):
    page = BenchPage(browser, patient, "ann", WIDE)
    yield page
    assert page.errors == []
    page.close()


@pytest.mark.story
def test_an_episode_is_reviewed_by_keyboard_and_the_next_one_comes(reviewer, patient, brought):
    newer, older = brought
    keys, page = reviewer.page.keyboard, reviewer.page
    eventually(
        lambda: all(
            reviewer.api(f"episodes/{uuid}")["previewed_at"]
            and reviewer.api(f"episodes/{uuid}/reviews")["quality"]
            for uuid in brought
        ),
        90,
        "both are prepared and checked",
    )
    reviewer.open("/replay/?review=unreviewed&quality=flagged")
    assert page.locator(f"[data-episode='{newer}'] .episode-quality").inner_text() == "1 flag"
    assert page.locator(f"[data-episode='{older}']").count() == 0

    reviewer.open(f"/replay/{newer}/")
    page.locator("#flags .lane-band[data-severity=error]").wait_for()
    band, axis = (page.locator(place).bounding_box() for place in ("#flags .lane-band", "#flags"))
    assert (band["x"] - axis["x"]) / axis["width"] == pytest.approx(40 / built.FRAMES, abs=0.01)
    assert band["width"] / axis["width"] == pytest.approx(20 / built.FRAMES, abs=0.01)
    keys.press("g")
    eventually(lambda: "row 40 of" in page.locator("#time").inner_text(), 10, "the flag's first row is shown")
    page.locator("#flag-here", has_text="cam_high is black").wait_for()

    keys.press("[")
    for _ in range(10):
        keys.press("ArrowRight")
    keys.press("]")
    keys.type("reach")
    keys.press("Tab")
    keys.type("cup touched")
    keys.press("Enter")
    page.locator("#segments .lane-band[data-own=true]", has_text="reach").wait_for()
    keys.press("n")
    keys.type("dark <b>for a moment</b>")
    keys.press("Enter")
    eventually(lambda: page.locator("#history-count").inner_text() == "History 1", 10, "the note is kept")
    assert page.locator("#review-state").inner_text() == "unreviewed"
    keys.press("f")
    eventually(lambda: page.locator("#review-state").inner_text() == "fail by ann", 10, "the verdict stands")
    keys.press("?")
    page.locator("#review-keys").wait_for()
    keys.press("Escape")
    page.locator("#review-keys").wait_for(state="hidden")

    said = reviewer.api(f"episodes/{newer}/reviews")
    assert [(one["verdict"], one["note"]) for one in said["reviews"]] == [
        ("fail", ""),
        ("note", "dark <b>for a moment</b>"),
    ]
    (segment,) = said["segments"]
    told = {name: segment[name] for name in ("first", "last", "label", "milestone", "annotator")}
    assert told == {"first": 40, "last": 50, "label": "reach", "milestone": "cup touched", "annotator": "ann"}
    kept = (patient.data / "reviews" / f"{newer}.jsonl").read_text().splitlines()
    assert [json.loads(line)["kind"] for line in kept] == ["segment", "review", "review"]

    keys.press("u")
    page.wait_for_url(lambda url: newer not in url)
    page.locator("#flags-count", has_text="Clean").wait_for()
    assert older in page.url
    keys.press("p")
    eventually(lambda: page.locator("#review-state").inner_text() == "pass by ann", 10, "the verdict stands")
    reviewer.open("/replay/?review=unreviewed")
    assert page.locator(f"[data-episode='{newer}'], [data-episode='{older}']").count() == 0
