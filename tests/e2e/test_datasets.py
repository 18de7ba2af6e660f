"""Datasets in a real browser: played from a shared file, beside each other; those of others imported and reviewed."""

import json
import os
import shutil
from itertools import pairwise

import pytest

from tests.e2e.by_hand import DebugPage
from tests.e2e.lab import WIDE
from tests.e2e.pixels import share, white
from tests.processes import PATIENCE_MS, PATIENCE_S, eventually
from tests.runtime.datasets.foreign import Plan, shown, write

pytestmark = pytest.mark.slow
FPS, LENGTHS = 10.0, (40, 50, 60)
SAMPLE = os.environ.get("EVA_SAMPLE_EPISODE")
# The number that the test's pictures show: the brightness in the middle of the video.
NUMBER = """(video) => {
  const canvas = new OffscreenCanvas(4, 4).getContext("2d");
  canvas.drawImage(video, 0, 0, 4, 4);
  return Math.round((canvas.getImageData(1, 1, 1, 1).data[0] - 30) / 5);
}"""


@pytest.fixture(scope="module")
def cups(patient):
    """A dataset of somebody else: three episodes in one file for each camera."""
    folder = patient.data / "datasets" / "cups"
    write(folder, Plan("v3.0", lengths=LENGTHS, fps=FPS, gop=10, per_data=9, per_video=9))
    return folder


@pytest.fixture(scope="module")
def viewer(browser, patient):
    page = DebugPage(browser, patient, "ann", WIDE)
    yield page
    assert page.errors == []
    page.close()


def row(page):
    return page.locator("#scrub").evaluate("(scrub) => Number(scrub.value)")


def numbers(page):
    return page.locator("video[data-camera]").evaluate_all(f"(all) => all.map({NUMBER})")


def test_an_episode_is_played_from_its_place_in_a_file_and_the_address_says_how(viewer, cups):
    page = viewer.open("/replay/datasets/").page
    page.locator("[data-dataset='datasets/cups'] a").click()
    page.locator("[data-index='2'] a").first.click()
    page.wait_for_url(lambda url: url.endswith("/replay/datasets/cups/-/2/"))
    viewer.open("/replay/datasets/cups/-/2/?t=3&from=2&to=4&loop=1&speed=2")
    eventually(lambda: row(page) == 30, "the row of the address is shown")
    eventually(lambda: numbers(page) == [shown(2, 30)] * 2, "both cameras show that row of that episode")
    page.keyboard.press("ArrowRight")
    eventually(lambda: numbers(page) == [shown(2, 31)] * 2, "both cameras show the next row")
    page.locator("#curves canvas").wait_for()

    page.keyboard.press("Space")
    seen = []

    def begins_again():
        page.wait_for_timeout(50)
        seen.append(row(page))
        return sum(now < before for before, now in pairwise(seen)) >= 2 and len(set(seen)) > 3

    eventually(begins_again, "it is played from the first row of the range again, twice")
    page.keyboard.press("Space")
    assert set(seen) <= set(range(20, 40))
    page.keyboard.press("r")
    page.keyboard.press("Home")
    for _ in range(4):
        page.keyboard.press("ArrowRight")
    page.keyboard.press("o")
    page.wait_for_url(lambda url: "from=0&to=0.5" in url and "t=0.4" in url and "speed=2" in url)
    page.locator("#range").wait_for()


def test_two_episodes_are_seen_beside_each_other_on_one_clock(viewer, cups):
    page = viewer.open("/replay/side-by-side/?show=cups:0&show=cups:1&offset=0,1&t=2").page
    one, other = (page.locator(f"[data-episode='datasets/cups:{index}'] [data-row]") for index in (0, 1))
    eventually(lambda: one.inner_text() == "row 20 of 40", "the first one stands at its row")
    eventually(lambda: other.inner_text() == "row 10 of 50", "the other one stands at its own")
    expected = [shown(0, 20)] * 2 + [shown(1, 10)] * 2
    eventually(lambda: numbers(page) == expected, "all cameras show their own row")
    page.locator("#curves .u-over").wait_for()
    page.keyboard.press("End")
    eventually(lambda: other.inner_text() == "row 49 of 50", "the longer one is at its end")
    eventually(lambda: one.inner_text() == "is over", "the shorter one is over")


@pytest.mark.skipif(not SAMPLE, reason="EVA_SAMPLE_EPISODE does not name the real episode")
def test_a_dataset_of_somebody_else_is_imported_replayed_and_reviewed(viewer, patient):
    folder = patient.data / "datasets" / "theirs"
    shutil.copytree(SAMPLE, folder)
    page, keys = viewer.open("/replay/datasets/theirs/").page, viewer.page.keyboard
    page.locator("summary", has_text="Import").click()
    page.locator("details[open] select[name=robot]").select_option("agilex_piper")
    page.locator("details[open] button[value=import]").click()
    done = page.locator("[data-job][data-state=done]", has_text="Import theirs")
    done.wait_for(timeout=3 * PATIENCE_MS)
    assert "1 episode can be reviewed, 1 new" in done.inner_text()
    page.reload()
    page.locator("[data-index='0'] a[href^='/replay/']:not([href*=datasets])").click()
    page.wait_for_url(lambda url: "/datasets/" not in url)
    uuid = page.url.rstrip("/").rpartition("/")[2]
    page.locator("#scrub").wait_for(timeout=3 * PATIENCE_MS)  # its preview is made
    eventually(
        lambda: viewer.api(f"episodes/{uuid}/reviews")["quality"],
        "it is looked through by itself",
        3 * PATIENCE_S,
    )

    viewer.open(f"/replay/{uuid}/")
    keys.press("End")
    eventually(lambda: row(page) == 397, "the last row is shown")
    keys.press("Home")
    videos = page.locator("video[data-camera]")
    eventually(
        lambda: (
            videos.evaluate_all("(all) => all.filter((one) => one.readyState >= 2 && !one.seeking).length")
            == 3
        ),
        "all three cameras show the first row",
    )
    assert share(viewer.scene(), white) > 0.003  # the arms are drawn
    page.locator("#curves .u-over").wait_for()
    keys.press("Space")
    eventually(lambda: row(page) > 10, "it plays")
    keys.press("Space")
    keys.press("f")
    eventually(lambda: page.locator("#review-state").inner_text() == "fail by ann", "it is reviewed")
    beside = folder / "eva" / "reviews" / f"{uuid}.jsonl"
    eventually(beside.exists, "what was said lies beside it in its dataset")
    assert [json.loads(line)["verdict"] for line in beside.read_text().splitlines()] == ["fail"]
    manifest = json.loads((patient.data / "episodes" / uuid / "manifest.json").read_text())
    assert sorted(manifest["streams"]) == ["eef", "eef_action", "effort", "qvel"]
