"""The story of the lab in a real browser: take the station, run a trial, score it, find it in Result and Replay."""

import csv
import io
import re

import pytest

from tests.e2e.bench_page import BenchPage
from tests.e2e.lab import STATION, WIDE
from tests.e2e.pixels import moved, orange, pixels, share, white, wood
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.slow
CHECKPOINT = "pick-place-40k"


@pytest.fixture(scope="module")
def operator(browser, patient):
    bench = BenchPage(browser, patient, "operator", WIDE).open(f"/stations/{STATION}/eval/")
    yield bench
    assert bench.errors == []
    bench.close()


@pytest.fixture(scope="module")
def trial(operator):
    """A whole trial by hand; what was seen on the way."""
    seen = {}
    operator.reaches("IDLE")
    seen["cameras"] = operator.cameras_live()
    seen["idle"] = {"overhead": operator.camera("cam_high"), "scene": operator.scene()}
    operator.take()
    page = operator.page
    page.select_option("#scene-choice", "block-on-plate")
    page.check("input[name=position][value='1']")
    page.select_option("#checkpoint-choice", CHECKPOINT)
    page.fill("#seed-choice", "1")
    page.click("[data-prepare]")
    operator.reaches("READY")
    seen["ready"] = {"overhead": operator.camera("cam_high"), "scene": operator.scene()}
    operator.press("run")
    operator.reaches("RUNNING")
    eventually(lambda: operator.truth()["milestones"]["lifted"], "the block is lifted", 3 * PATIENCE_S)
    seen["carried"] = {"overhead": operator.camera("cam_high"), "scene": operator.scene()}
    eventually(lambda: operator.truth()["success"], "the block lies on the plate", 3 * PATIENCE_S)
    page.keyboard.press("s")
    operator.reaches("READY")
    page.locator("#score .verdict", has_text=":").wait_for()  # a script writes it once the card is there
    seen["verdicts"] = [page.locator("#score .verdict").inner_text()]
    for check in page.locator("input[name=milestone]").all():
        check.check()
    seen["verdicts"].append(page.locator("#score .verdict").inner_text())
    page.fill("#note", "first try, <b>gripper</b> a little late")
    page.locator("button[form=score]").click()
    eventually(lambda: operator.api("trials")["items"][0]["status"] == "scored", "the trial is scored")
    seen["trial"] = operator.api("trials")["items"][0]
    return seen


@pytest.mark.story
def test_three_cameras_and_the_robot_are_seen_before_anything_is_pressed(trial):
    assert trial["cameras"] == 3
    assert share(trial["idle"]["overhead"], wood) > 0.3
    assert trial["idle"]["overhead"].std() > 20
    assert share(trial["idle"]["scene"], white) > 0.005
    assert share(trial["idle"]["scene"], wood) > 0.05


@pytest.mark.story
def test_the_robot_moves_in_the_pictures_and_in_3d(trial):
    assert share(trial["ready"]["overhead"], orange) > 0.002
    for pane in ("overhead", "scene"):
        assert moved(trial["ready"][pane], trial["carried"][pane]) > 0.01


@pytest.mark.story
def test_the_score_is_kept_with_its_words(trial):
    asked, ticked = trial["verdicts"]
    assert asked.startswith("Success means: ")
    assert ticked == "Success"
    kept = trial["trial"]
    assert (kept["success"], kept["score"]) == (True, 1.0)
    assert kept["note"] == "first try, <b>gripper</b> a little late"
    assert kept["checkpoint"] == CHECKPOINT
    assert kept["duration_s"] > 5


@pytest.mark.story
def test_result_shows_the_trial_with_its_video(trial, operator):
    page = operator.open("/result/").page
    row = page.locator("tr", has_text="scored").first
    assert CHECKPOINT in row.inner_text()
    assert page.locator("#estop").count() == 0
    operator.open(f"/result/trials/{trial['trial']['id']}/")
    eventually(
        lambda: operator.api(f"episodes/{trial['trial']['episode']}")["previewed_at"],
        "the videos are there",
        3 * PATIENCE_S,
    )
    page.reload()
    assert "<b>gripper</b>" in page.locator("main").inner_text()
    video = page.locator("video").first
    video.scroll_into_view_if_needed()
    eventually(lambda: video.evaluate("v => v.readyState >= 2 && v.duration > 5"), "the video can be played")
    video.evaluate("v => { v.currentTime = 0.8 * v.duration }")
    eventually(lambda: video.evaluate("v => !v.seeking && v.readyState >= 2"), "the video jumps")
    assert share(pixels(video), wood) > 0.2


@pytest.mark.story
def test_the_episode_plays_back_on_one_clock(trial, operator):
    page = operator.open(f"/replay/{trial['trial']['episode']}/").page
    videos = page.locator("video")
    eventually(lambda: videos.count() == 3, "three videos")

    def together():
        times = videos.evaluate_all(
            "all => all.map(v => v.readyState >= 2 && !v.seeking ? v.currentTime : -1)"
        )
        return min(times) > 3 and max(times) - min(times) < 0.5  # the robot is on its way by then

    scene = page.locator(".replay-scene, #scene").first
    eventually(lambda: share(pixels(scene), white) > 0.003, "the robot is drawn")
    before = pixels(scene)
    page.keyboard.press("Space")
    eventually(together, "the videos play together")
    page.keyboard.press("Space")
    eventually(lambda: moved(before, pixels(scene)) > 0.002, "the robot is drawn where it is by now")
    assert page.locator("canvas").count() >= 2


def test_the_playback_says_whose_step_it_is_and_gives_the_streams_away(trial, operator):
    page = operator.open(f"/replay/{trial['trial']['episode']}/").page
    over = page.locator("#curves .u-over")
    over.wait_for()
    told = page.locator("#chunk")
    box = over.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    eventually(lambda: "delay" in told.inner_text(), "the chunk under the pointer is told")
    found = re.search(
        r"chunk (\d+) · (\w+)delay \d+ steps? \(\d+ ms\)rows \d+ to \d+ of \d+", told.inner_text()
    )
    assert found, told.inner_text()
    assert found[2] in ("async", "sync", "ensemble", "naive", "rtc")
    for _ in range(3):
        page.keyboard.press("ArrowRight")  # the pointer wins over the clock while it is there
    assert f"chunk {found[1]} " in told.inner_text()
    assert {"chunk", "overlap"} <= set(page.locator("#legend-marks .strong").all_text_contents())
    page.locator(".replay-details summary").click()
    table = page.locator("#export-table a")
    table.wait_for()
    answer = page.request.get(f"{operator.demo.url}{table.get_attribute('href')}")
    assert answer.body()[:4] == answer.body()[-4:] == b"PAR1"
    assert operator.errors == []


def test_space_on_a_page_that_is_not_a_stations_stops_no_robot(trial, operator):
    assert operator.snapshot()["state"] != "faulted"


@pytest.mark.story
def test_the_dataset_has_the_episode(trial, operator):
    episode = operator.api(f"episodes/{trial['trial']['episode']}")
    found = eventually(
        lambda: operator.api(f"episodes/{episode['uuid']}")["dataset_index"] is not None,
        "it is published",
        3 * PATIENCE_S,
    )
    assert found


def test_rest_says_the_same_in_json_and_csv(trial, operator):
    for resource in ("trials", "statistics"):
        rows = operator.api(resource)["items"]
        text = operator.page.request.get(f"{operator.demo.url}/api/v1/{resource}?format=csv")
        assert text.headers["content-type"].startswith("text/csv")
        table = list(csv.DictReader(io.StringIO(text.text())))
        assert len(table) == len(rows) > 0
        assert table[0]["checkpoint"] == rows[0]["checkpoint"]
        assert set(table[0]) <= set(rows[0]) | {key for key in table[0] if "." in key or "_" in key}


def test_an_administrator_adds_a_scene_with_its_milestones_and_a_checkpoint(
    browser, patient, trial, operator
):
    admin = BenchPage(browser, patient, "admin", WIDE).open("/admin/trials/scene/add/")
    page = admin.page
    page.fill("#id_title", "Stack two blocks")
    page.fill("#id_name", "stack-two")
    page.fill("#id_instruction", "stack the blocks")
    page.fill("#id_positions-0-number", "1")
    page.click("#milestones-group .add-row a")
    page.fill("#id_milestones-0-order", "1")
    page.fill("#id_milestones-0-text", "The blocks stand")
    page.click("input[name=_save]")
    page.wait_for_url("**/admin/trials/scene/")
    admin.open("/admin/trials/checkpoint/add/")
    page.fill("#id_name", "another-policy")
    page.fill("#id_policy", '{"url": "ws://127.0.0.1:1"}')
    page.click("input[name=_save]")
    page.wait_for_url("**/admin/trials/checkpoint/")
    assert admin.errors == []
    admin.close()
    operator.open(f"/stations/{STATION}/eval/")
    operator.page.locator("#scene-choice").wait_for()
    assert "Stack two blocks" in operator.page.locator("#scene-choice").inner_text()
    assert "another-policy" in operator.page.locator("#checkpoint-choice").inner_text()
