"""An administrator lays a scene by sight, with what is on screen alone, and the Eval page offers it."""

import io
import re

import pytest
from PIL import Image

from tests.e2e.bench_page import BenchPage
from tests.e2e.lab import STATION, WIDE
from tests.e2e.remote import reset_station, visitor
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.slow
TITLE = "Block beside the plate"


@pytest.fixture
def admin(browser, patient):
    reset_station(visitor(patient, "admin"))
    bench = BenchPage(browser, patient, "admin", WIDE)
    yield bench
    assert bench.errors == []
    bench.close()


def drag(page, what, right, down):
    """Press in the middle of it, move, let go."""
    what.scroll_into_view_if_needed()
    box = what.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + right / 2, y + down / 2)
    page.mouse.move(x + right, y + down)
    page.mouse.up()


def number(page, name):
    return float(page.get_by_label(f"block: {name}", exact=True).input_value())


def _picture():
    file = io.BytesIO()
    Image.new("RGB", (640, 480), "grey").save(file, "PNG")
    return file.getvalue()


def test_a_scene_is_laid_by_dragging_and_offered_at_the_bench(admin):
    page = admin.page
    page.locator(".bar-user > summary").click()
    page.get_by_role("link", name="Set up a lab").click()
    page.get_by_role("link", name="Add a scene").click()
    page.locator(".scene-grid:not([inert])").wait_for()
    page.get_by_label("Title").fill(TITLE)
    page.get_by_label("Instruction").fill("put the block beside the plate")
    page.get_by_label("Criterion").fill("The block stands beside the plate.")

    block = page.locator("#stage [data-thing=block] .shape")
    drag(page, block, -30, 20)
    for across, down in ((30, 20), (30, 20), (-40, -60)):  # three more, each from the one before
        page.get_by_role("button", name="Add a position").click()
        before = number(page, "x mm")
        drag(page, block, across, down)
        assert (number(page, "x mm") > before) == (across > 0)
        assert page.locator("#bench-problems").inner_text() == ""
    assert page.locator("#thumbnails li").count() == 4
    turned = number(page, "turn °")
    drag(page, page.locator("#stage [data-turn]"), 40, 10)
    assert number(page, "turn °") != turned
    x, y, turn = (number(page, name) for name in ("x mm", "y mm", "turn °"))
    for key in ("ArrowLeft", "Shift+ArrowDown", "PageUp"):
        page.keyboard.press(key)
    assert [number(page, name) for name in ("x mm", "y mm", "turn °")] == [x - 10, y - 1, turn + 5]

    page.locator("[data-overlay=file]").set_input_files(
        {"name": "bench.png", "mimeType": "image/png", "buffer": _picture()}
    )
    page.locator("#overlay > summary").click()  # on a picture of the real bench, with keys and by dragging
    page.locator("[data-overlay=picture]:not([hidden])").wait_for()
    over = page.locator("[data-overlay=svg] [data-over=block]")
    over.focus()
    for key in ("ArrowLeft", "Shift+ArrowUp", "Shift+PageUp"):
        page.keyboard.press(key)
    assert [number(page, name) for name in ("x mm", "y mm", "turn °")] == [x - 20, y, turn + 6]
    assert over.evaluate("(thing) => thing === document.activeElement")
    assert "turned by" in over.get_attribute("aria-label")
    drag(page, over, 60, 0)
    assert number(page, "x mm") > x - 20
    page.locator("#overlay > summary").click()

    for text in ("The block stands", "The gripper holds the block"):
        page.get_by_role("button", name="Add a milestone").click()
        page.keyboard.type(text)
    row = page.locator("#milestone-rows > li")
    drag(page, row.nth(1).locator("[data-handle]"), 0, -row.nth(0).bounding_box()["height"])
    page.get_by_label("Milestone 1", exact=True).wait_for()
    texts = [page.get_by_label(f"Milestone {n}", exact=True).input_value() for n in (1, 2)]
    assert texts == ["The gripper holds the block", "The block stands"]
    assert row.locator("> kbd").all_inner_texts() == ["1", "2"]
    row.nth(1).get_by_label("required for success").check()

    seen = page.locator("#preview .check")  # as the operator will
    eventually(
        lambda: (
            [re.split(r"\n", text)[0] for text in seen.all_inner_texts()] == texts
            and "required for success" in seen.nth(1).inner_text()
        ),
        "the preview shows both milestones as they are",
        3 * PATIENCE_S,
    )
    assert page.locator("#preview kbd", has_text=re.compile("^[12]$")).count() == 2
    assert "beside the plate." in page.locator("#preview").inner_text()

    with page.expect_response(lambda answer: answer.url.endswith("/setup/new-scene/")) as saved:
        page.get_by_role("button", name="Save scene").click()
    assert saved.value.ok, saved.value.text()
    page.wait_for_url("**/setup/scenes/block-beside-the-plate/")
    page.get_by_role("heading", level=1, name=TITLE).wait_for()
    page.reload()
    assert page.locator("#thumbnails li").count() == 4
    assert page.locator("#unsaved").is_hidden()

    page.get_by_role(
        "link", name="EVA", exact=True
    ).click()  # the tab may lead to another station of this lab
    page.locator(f".station-card:has([data-live='{STATION}'])").get_by_role("link", name="Open Eval").click()
    page.wait_for_url(f"**/stations/{STATION}/eval/")
    page.locator("#scene-choice").select_option(label=TITLE)
    page.locator("#choose", has_text="put the block beside the plate").wait_for()
    assert page.locator("#choose [name=position]").count() == 4
