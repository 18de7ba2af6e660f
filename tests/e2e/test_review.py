"""The review of recorded episodes in a real browser, by keyboard alone: flags, verdicts, annotations, the next one."""

import json
import time

import numpy as np
import pytest

from tests.e2e.bench_page import BenchPage
from tests.e2e.lab import WIDE
from tests.processes import PATIENCE_S, eventually
from tests.runtime.quality import built

pytestmark = pytest.mark.slow
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
        "both are prepared and checked",
        3 * PATIENCE_S,
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
    eventually(lambda: "row 40 of" in page.locator("#time").inner_text(), "the flag's first row is shown")
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
    eventually(lambda: page.locator("#history-count").inner_text() == "Reviews 1", "the note is kept")
    assert page.locator("#review-state").inner_text() == "unreviewed"
    keys.press("f")
    eventually(lambda: page.locator("#review-state").inner_text() == "fail by ann", "the verdict stands")
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
    eventually(lambda: page.locator("#review-state").inner_text() == "pass by ann", "the verdict stands")
    reviewer.open("/replay/?review=unreviewed")
    assert page.locator(f"[data-episode='{newer}'], [data-episode='{older}']").count() == 0


# How long from the key to the frame: each of these rows, in the order of no video, is shown by all cameras.
SEEKS = """async (rows) => {
  const scrub = document.getElementById("scrub");
  const fps = JSON.parse(document.getElementById("config").textContent).fps;
  const shown = (video, row) => new Promise((done) => {
    const look = (now, { mediaTime }) => {
      if (Math.abs(mediaTime - row / fps) < 0.6 / fps) done(performance.now());
      else video.requestVideoFrameCallback(look);
    };
    video.requestVideoFrameCallback(look);
  });
  const took = [];
  for (const row of rows) {
    const all = [...document.querySelectorAll("video[data-camera]")].map((video) => shown(video, row));
    const begun = performance.now();
    scrub.value = row;
    scrub.dispatchEvent(new Event("input"));
    took.push(Math.max(...(await Promise.all(all))) - begun);
  }
  return took;
}"""
IN_SIGHT = """(places) => places.filter((place) => {
  const { top, bottom, height } = document.querySelector(place).getBoundingClientRect();
  return !height || top < 0 || bottom > innerHeight;
})"""


def played(reviewer, uuid):
    """The page of an episode, once it can be played."""
    eventually(
        lambda: reviewer.api(f"episodes/{uuid}")["previewed_at"], "the episode is prepared", 3 * PATIENCE_S
    )
    page = reviewer.open(f"/replay/{uuid}/").page
    page.locator("#curves .u-over").wait_for()
    page.locator("#segment-vocabulary button").first.wait_for()
    return page


def test_cameras_come_first_and_one_of_them_is_enlarged_while_all_follow_the_pointer(reviewer, brought):
    page = played(reviewer, brought[1])
    cameras = [f"video[data-camera={name}]" for name in ("cam_high", "cam_left_wrist", "cam_right_wrist")]
    assert page.evaluate(IN_SIGHT, [*cameras, "#scrub", "#play", "#segments", "#curves"]) == []
    assert page.locator(".replay-details dl").is_hidden()
    small = page.locator(cameras[1]).bounding_box()
    page.locator(cameras[1]).click()
    assert page.locator(cameras[1]).bounding_box()["width"] > 1.5 * small["width"]
    page.reload()
    page.locator(".replay-camera[data-large] video[data-camera=cam_left_wrist]").wait_for()
    page.keyboard.press("v")
    page.keyboard.press("v")
    assert page.locator("#cameras[data-focus]").count() == 0

    page.locator("#curves .u-over").wait_for()
    assert page.locator("#plots .u-over").count() == 4  # those that move most
    page.get_by_role("button", name="Add", exact=True).click()
    assert page.locator("#plots .u-over").count() == 5
    page.locator("#joint").select_option(label="right_arm.joint6")
    page.reload()
    page.locator("#curves .u-over").wait_for()
    assert page.locator("#plots .u-over").count() == 5
    assert page.locator("#joint").evaluate("(one) => one.selectedOptions[0].text") == "right_arm.joint6"

    axis = page.locator("#scrub").bounding_box()
    page.mouse.move(axis["x"] + 0.5 * axis["width"], axis["y"] + 10)
    pictures = page.locator("#hover .timeline-picture")
    eventually(
        lambda: (
            pictures.evaluate_all(
                "all => all.filter((one) => one.style.backgroundImage && one.offsetHeight > 20).length"
            )
            == 3
        ),
        "each camera shows what is there",
    )
    assert f"row {built.FRAMES // 2}" in page.locator("#hover").inner_text()
    page.mouse.move(5, 5)
    assert page.locator("#hover").is_hidden()
    rows = [(37 * number) % built.FRAMES for number in range(1, 9)]
    assert len(page.evaluate(SEEKS, rows)) == len(rows)


def test_parts_are_marked_by_a_key_drawn_and_moved_by_pointer_and_keyboard(reviewer, brought):
    uuid = brought[1]
    page, keys = played(reviewer, uuid), reviewer.page.keyboard

    def marked():
        said = reviewer.api(f"episodes/{uuid}/reviews")["segments"]
        return [(one["label"], one["first"], one["last"]) for one in said]

    keys.press("Home")
    keys.press("1")
    for _ in range(5):
        keys.press("ArrowRight")
    keys.press("2")  # takes over
    for _ in range(5):
        keys.press("ArrowRight")
    keys.press("2")  # ends
    eventually(lambda: marked() == [("approach", 0, 4), ("grasp", 5, 10)], "two parts follow each other")
    end = page.get_by_role("slider", name="Last row of grasp")
    end.focus()
    for _ in range(3):
        keys.press("ArrowRight")
    eventually(lambda: marked()[1] == ("grasp", 5, 13), "its end is three rows later")
    eventually(lambda: end.get_attribute("aria-valuenow") == "13", "the page says so")
    assert "row 13 of" in page.locator("#time").inner_text()  # the picture of that row is shown
    end.evaluate("(one) => one.blur()")

    lane = page.locator("#segments").bounding_box()
    at = lambda share: (lane["x"] + share * lane["width"], lane["y"] + 8)  # noqa: E731
    page.mouse.move(*at(0.5))
    page.mouse.down()
    page.mouse.move(*at(0.75), steps=4)
    page.mouse.up()
    page.locator("#segment-form").wait_for()
    keys.type("place <it>")
    keys.press("Enter")
    eventually(lambda: len(marked()) == 3, "what was drawn is kept")
    label, first, last = marked()[2]
    assert label == "place <it>"
    assert (first / built.FRAMES, last / built.FRAMES) == (
        pytest.approx(0.5, abs=0.03),
        pytest.approx(0.75, abs=0.03),
    )
    page.locator(".lane-segment", has_text="place <it>").wait_for()
    assert page.locator(".lane-overlap").count() == 0
    handle = page.get_by_role("slider", name="First row of place").bounding_box()
    page.mouse.move(handle["x"] + handle["width"] / 2, handle["y"] + handle["height"] / 2)
    page.mouse.down()
    page.mouse.move(*at(0.08), steps=4)
    page.mouse.up()
    starts = lambda: {label: first for label, first, _ in marked()}  # noqa: E731
    eventually(lambda: starts()["place <it>"] < 13, "its first row is where it was put")
    page.locator(".lane-overlap").wait_for()
    page.reload()
    page.locator(".lane-overlap").wait_for()


TWENTY = 20


@pytest.fixture(scope="module")
def twenty(patient):
    """As many more, the newest of all, prepared and checked; by uuid, the newest first."""
    now, root = time.time(), patient.data / "episodes"
    made = [
        built.record_of(root, ROBOT, frames=30, started_wall=now + TWENTY - n, station="bench-1").name
        for n in range(TWENTY)
    ]
    patient.python("from evaweb.episodes.reconcile import reconcile; reconcile()")
    return made


def test_twenty_episodes_are_reviewed_with_one_key_each(reviewer, patient, twenty):
    page, keys = reviewer.page, reviewer.page.keyboard
    count = "SELECT COUNT(*) FROM episodes_episode WHERE previewed_at IS NOT NULL AND uuid IN ({})"
    asked = count.format(", ".join("?" * TWENTY))
    bare = [uuid.replace("-", "") for uuid in twenty]
    eventually(lambda: patient.rows(asked, *bare) == [(TWENTY,)], "all are prepared", 3 * PATIENCE_S)
    reviewer.open("/replay/?review=unreviewed")
    page.locator(f"[data-episode='{twenty[0]}'] a").first.click()
    took = []
    for number, uuid in enumerate(twenty):
        page.wait_for_url(lambda url, uuid=uuid: uuid in url)
        page.locator("#review-state", has_text="unreviewed").wait_for()
        begun = time.monotonic()
        if number == 4:
            keys.press("n")
            keys.type("lets go late")
            keys.press("Enter")
            page.locator("#history-count", has_text="Reviews 1").wait_for()
        if number == 0:
            page.select_option("#speed", "2")
            page.locator("h1").click()
        keys.press("Shift+F" if number % 5 == 4 else "Shift+P")
        if number + 1 < TWENTY:
            page.wait_for_url(lambda url, uuid=twenty[number + 1]: uuid in url)
            page.locator("#review-state", has_text="unreviewed").wait_for()
            assert "speed=2" in page.url
        took.append(time.monotonic() - begun)
    print(f"{TWENTY} episodes in {sum(took):.0f} s")
    verdicts = [reviewer.api(f"episodes/{uuid}/reviews")["verdict"]["verdict"] for uuid in twenty[:-1]]
    assert verdicts == ["fail" if n % 5 == 4 else "pass" for n in range(TWENTY - 1)]
