"""The Debug tab by hand, in every mode, with the real processes: what is pressed, what is said, what moves."""

import math
import socket
from functools import partial

import pytest

from tests.e2e.by_hand import DebugPage
from tests.e2e.lab import STATION, WIDE
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.slow
MUTE = "mute-policy"
_MUTE = f"""
from evaweb.lab.demo_rows import demo_checkpoint
demo_checkpoint(name="{MUTE}", description="", policy={{{{"url": "ws://127.0.0.1:{{port}}"}}}})
"""


@pytest.fixture(scope="module")
def bench(browser, patient):
    bench = DebugPage(browser, patient, "operator", WIDE).open(f"/stations/{STATION}/debug/")
    bench.at_rest()
    bench.take()
    bench.page.fill("#seed", "1")  # the block is put back: whoever has done the task does not move any more
    yield bench
    assert bench.errors == []
    bench.close()


@pytest.fixture
def ready(bench):
    """Set up, at the start pose, and left so that the next test can begin."""
    bench.take_again()
    bench.set_up()
    yield bench
    if bench.state() in ("RUNNING", "HOLDING"):
        bench.stop()


def test_the_set_up_shows_its_stages_and_can_be_cancelled_and_repeated(bench, patient):
    with socket.create_server(("127.0.0.1", 0)) as mute:  # so that there is something to be cancelled
        patient.python(_MUTE.format(port=mute.getsockname()[1]))
        bench.page.reload()
        bench.at_rest()
        bench.take_again()
        bench.page.select_option("#checkpoint", label=MUTE)
        bench.keys("u")
        active = bench.page.locator("[data-stages] [data-state=active]")
        active.first.wait_for()
        assert bench.page.locator("[data-stages] li").count() >= 4
        bench.keys("s")
        bench.reaches("IDLE")
    assert "cancelled" in bench.snapshot()["reason"]
    bench.answered("setup")  # the station may have begun, and ended, before the page hears that it was asked
    bench.page.select_option("#checkpoint", "")
    bench.keys("u")
    bench.reaches("READY")
    bench.quiet("[data-stages]")


def test_sim_says_what_the_policy_sees_and_moves_nothing(ready):
    before, block = ready.joints(), ready.truth()
    ready.keys("1", "q")
    ready.run_in("sim")
    ready.says("[data-mode=note]", "The policy sees the simulated robot's joints and the live cameras.")
    ready.says("[data-mode=phase]", "executing")
    eventually(lambda: ready.snapshot()["policy"]["answers"] > 4, "the policy is asked")
    assert not ready.moved_from(before)
    assert ready.truth()["milestones"] == block["milestones"]
    ready.stop()
    ready.keys("Shift+Q")
    ready.run_in("sim")
    ready.says("[data-mode=note]", "the real robot's joints, which do not follow it")
    assert ready.snapshot()["sim_state"] == "live"
    ready.stop()
    ready.keys("q")


def test_step_moves_the_robot_by_one_chunk_for_each_press(ready):
    before = ready.joints()
    ready.run_in("step")
    ready.says("[data-mode=phase]", "waiting for you")
    assert not ready.moved_from(before)
    ready.press("step")
    eventually(lambda: ready.moved_from(before), "the robot moves")
    eventually(ready.stands, "the robot stands after one chunk")
    ready.says("[data-mode=phase]", "waiting for you")
    rest = ready.joints()
    ready.page.wait_for_timeout(500)
    assert ready.joints() == rest
    ready.press("step")
    eventually(lambda: ready.moved_from(rest), "it goes on")


def test_preview_shows_a_chunk_that_is_cancelled_or_committed(ready):
    before = ready.joints()
    ready.run_in("preview")
    ready.press("step")
    ready.says("[data-mode=note]", "Chunk")
    ready.says("[data-mode=phase]", "a chunk is shown")
    ready.page.locator("[data-primary=commit]").wait_for()
    ready.keys("x")
    ready.quiet("[data-mode=note]")
    assert ready.snapshot()["proposal"] == {}
    assert not ready.moved_from(before)
    ready.step_and_commit(before)
    ready.says("[data-mode=phase]", "waiting for you")


@pytest.mark.story
def test_strategy_and_prompt_are_switched_while_the_robot_moves(ready):
    page = ready.page
    ready.keys("6")
    ready.run_in("continuous")
    page.select_option("#strategy-kind", "ensemble")
    page.fill("#parameter-ensemble_horizon", "4")
    page.fill("#task", "put it on the plate, slowly")
    ready.says("[data-tune=edited]", "Strategy, Ensemble of, Prompt")
    ready.says("[data-tune=unused]", "Not used by ensemble: ")
    page.keyboard.press("Enter")
    ready.says("[data-tune=task]", "In force: “put it on the plate, slowly”")
    found = ready.snapshot()
    assert (found["tuning"]["kind"], found["tuning"]["ensemble_horizon"]) == ("ensemble", 4)
    assert (found["task"], found["state"]) == ("put it on the plate, slowly", "running")
    page.fill("#parameter-ensemble_horizon", "0")
    ready.says("[data-tune=edited]", "a whole number from 1")
    page.locator("[data-command=tune][aria-disabled=true]").wait_for()
    page.locator("[data-tune=undo]").click()
    page.locator("[data-tune=deployed]").click()
    ready.keys("d")
    eventually(lambda: ready.snapshot()["tuning"]["kind"] == "async", "the deployment's own again")
    assert ready.snapshot()["state"] == "running"


@pytest.mark.story
def test_by_hand_the_target_is_shown_first_and_moves_the_robot_when_sent(ready):
    page = ready.page
    before = ready.joints()
    ready.run_in("manual")
    page.locator("#panel-manual").wait_for()
    send = page.locator("[data-command=move]")
    eventually(lambda: "target is where the robot is" in send.get_attribute("title"), "Send says why not")
    ready.keys("i", *["ArrowRight"] * 20)
    target = ready.joints()
    assert target[0] == pytest.approx(before[0] + 0.2, abs=0.02)
    eventually(lambda: "rad from the robot" in ready.said(), "the station says how far that is")
    assert ready.snapshot()["phase"] == "waiting"
    page.keyboard.press("m")
    eventually(lambda: "has arrived" in ready.said(), "the robot is where it was sent")
    arrived = pytest.approx(target[0], abs=0.01)
    eventually(lambda: ready.joints()[0] == arrived, f"the page shows the joint at {target[0]}")


def test_the_hand_goes_by_steps_as_far_as_it_reaches(ready):
    page = ready.page
    ready.run_in("manual")
    before = ready.joints()
    ready.keys("Shift+H", "PageUp")
    eventually(lambda: ready.moved_from(before, 0.005), "the target is a step higher")
    ready.says("[data-target=at]", "mm")
    ready.press("move")
    eventually(lambda: "has arrived" in ready.said(), "the robot is a step higher")
    page.select_option("#jog-mm", "50")
    there = ready.joints()
    higher = page.locator("[data-jog='z+']:not([data-turn])")

    def beyond():
        reached = ready.joints()
        higher.click()
        return "Out of reach" in ready.said() and ready.joints() == reached

    eventually(beyond, "a step that is out of reach is said, and leaves the target where it was")
    ready.keys("0")
    eventually(lambda: not ready.moved_from(there), "the target is where the robot is")
    ready.keys("Shift+J")


def test_grippers_close_open_and_lock_where_they_are(ready):
    ready.run_in("manual")
    left = ready.page.locator(".gripper").first

    def at(value):
        eventually(
            lambda: ready.snapshot()["grippers"]["left_arm"]["at"] == pytest.approx(value, abs=0.005),
            f"the gripper is at {value}",
        )

    ready.keys("7", "i", *["ArrowRight"] * 5)  # a target from before it is closed does not open it again
    ready.keys("8", ".")
    at(0.0)
    ready.keys("7")
    ready.press("move")
    eventually(lambda: "has arrived" in ready.said(), "the robot is where it was sent")
    at(0.0)
    ready.keys("8")
    left.locator("[data-grip=lock]").click()
    eventually(lambda: "locked" in left.inner_text(), "it says that it is locked")
    assert ready.snapshot()["grippers"]["left_arm"]["locked"] is True
    unanswered = ready.page.locator("[data-grip][data-pressed]")
    unanswered.wait_for(state="detached")
    ready.keys("-")
    eventually(lambda: "locked" not in left.inner_text(), "it is free again")
    unanswered.wait_for(state="detached")
    ready.keys(",")
    at(0.1)
    ready.says("[data-drives=said]", "enabled, no fault")


def test_a_first_action_that_is_far_is_warned_of_and_approached(ready):
    page = ready.page
    ready.quiet("[data-mode=far]")
    ready.run_in("manual")
    page.select_option("#speed", "1")
    page.select_option("#pose", "home")
    eventually(lambda: "rad from the robot" in ready.said(), "the pose is a target")
    ready.press("move")
    eventually(lambda: "has arrived" in ready.said(), "the robot is at the named pose")
    ready.stop()
    ready.keys("4")
    ready.says("[data-mode=far-text]", "The policy's first action is")
    ready.keys("b")
    ready.reaches("SETTING UP")
    ready.reaches("READY")
    ready.quiet("[data-mode=far]")
    assert ready.snapshot()["first_action"]["far"] is False


@pytest.mark.story
def test_space_is_a_focused_controls_and_escape_closes_what_is_open_before_it_stops(ready):
    page = ready.page

    def faulted():
        return ready.snapshot()["state"] == "faulted"

    def stopped():
        ready.reaches("FAULTED")
        ready.press("release")
        ready.reaches("IDLE")

    def has_space(control, shown):
        """Space is the control's; a page that a busy machine left without news stops instead, and is asked again."""
        page.locator(control).focus()
        page.keyboard.press("Space")
        eventually(lambda: shown() or faulted(), f"Space is for {control}, or stops")
        if faulted():
            stopped()
        return shown()

    def closes(what, opened):
        """Escape closes it and stops nothing; but for a page without news, as above."""
        opened()
        page.locator(f"{what}[open]").wait_for()
        page.keyboard.press("Escape")
        page.locator(f"{what}:not([open])").wait_for(state="attached")
        if not faulted():
            return True
        stopped()
        return False

    ready.keys("6")
    controls = {
        "#task": lambda: page.locator("#task").input_value().endswith(" "),
        "#strategy-kind": lambda: page.locator("#strategy-kind:focus").count() == 1,
        "[data-toggle=frames]": page.locator("[data-toggle=frames][aria-pressed=true]").is_visible,
        ".bar-user summary": page.locator(".bar-user[open]").is_visible,
    }
    for control, shown in controls.items():
        eventually(partial(has_space, control, shown), f"Space is for {control}", 3 * PATIENCE_S)
    ready.keys("e")
    page.locator(".bar-user summary").click()
    menu = page.locator(".bar-user summary")
    eventually(
        lambda: closes("#keys", lambda: ready.keys("?")),
        "Escape closes the keys and stops nothing",
        3 * PATIENCE_S,
    )
    eventually(
        lambda: closes(".bar-user", menu.click), "Escape closes the menu and stops nothing", 3 * PATIENCE_S
    )

    page.locator("#task").focus()
    page.keyboard.press("Escape")
    stopped()
    page.locator("[data-toggle=frames]").click()  # what was clicked has not the keys
    page.keyboard.press("Space")
    stopped()
    page.locator("[data-toggle=frames]").click()
    ready.keys("?")
    page.keyboard.press("Space")  # nor has what only shows something
    stopped()
    ready.keys("?")


def test_escape_with_something_open_stops_a_robot_that_moves(ready):
    ready.run_in("continuous")
    ready.keys("?")
    ready.page.locator("#keys[open]").wait_for()
    ready.page.keyboard.press("Escape")
    ready.reaches("FAULTED")
    ready.page.locator("#keys:not([open])").wait_for(state="attached")
    ready.press("release")
    ready.reaches("IDLE")


_SEEN = """hidden => {
  Object.defineProperty(document, "hidden", { value: hidden, configurable: true });
  document.dispatchEvent(new Event("visibilitychange"));
}"""


def test_a_hidden_page_keeps_the_station_at_rest_and_lets_a_run_be_held(ready):
    epoch, left, renewed = ready.snapshot()["lease"]["epoch"], math.inf, 0
    ready.page.evaluate(_SEEN, True)

    def renewed_while_hidden():
        nonlocal left, renewed
        before, left = left, ready.snapshot()["lease"]["expires_in"]
        renewed += left > before
        return renewed > 2  # the first may have been on its way

    eventually(renewed_while_hidden, "the lease is renewed again and again")
    assert ready.snapshot()["lease"]["epoch"] == epoch
    assert ready.snapshot()["lease"]["holder"].startswith("web:operator:")
    ready.page.evaluate(_SEEN, False)

    ready.run_in("continuous")
    ready.page.evaluate(_SEEN, True)
    assert ready.page.title().startswith("COME BACK: holds in")

    def held_for_nobody():
        """What this machine was late with held the run before its lease ended: a station at rest keeps its holder."""
        found = ready.snapshot()
        if found["state"] == "holding" and found["lease"]["holder"] and ready.state() == "HOLDING":
            ready.keys("o")
            ready.answered("resume")
        return found["state"] == "holding" and not found["lease"]["holder"]

    eventually(held_for_nobody, "the run is held and nobody has the station", 3 * PATIENCE_S)
    ready.page.evaluate(_SEEN, False)
    ready.page.locator("#outcome", has_text="its lease has ended").wait_for()
    ready.take_again()
