"""A new lab by clicking only: an empty data folder, a first scored trial, and the link of why it failed."""

import re
import shutil
import signal
import subprocess
import sys
import time

import pytest

from tests.e2e.bench_page import BenchPage
from tests.e2e.conftest import SETS
from tests.e2e.lab import ROOT, WIDE, environment, unhandled
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.slow
STATION = "bench-1"


class EmptyLab:
    """`manage.py lab` on a data folder that is not there yet; what it says in its terminal is all that is known."""

    def __init__(self, folder):
        self.data, self.log = folder / "data", folder / "lab.log"
        with self.log.open("w") as output:
            self.child = subprocess.Popen(
                [sys.executable, "manage.py", "lab", "--port", "0", *SETS],
                cwd=ROOT,
                env=environment(self.data),
                stdout=output,
                stderr=output,
            )
        eventually(
            lambda: "type this code" in self.said(), "the lab is up and shows its code", 3 * PATIENCE_S
        )
        self.url = re.search(r"EVA Web is at (http://\S+?)/?\s", self.said())[1]
        self.code = re.search(r"type this code: +(\S+)", self.said())[1]
        self.passwords = {}  # of accounts that are made on the pages

    def said(self):
        assert self.child.poll() is None, self.log.read_text()[-2000:]
        return self.log.read_text()

    def end(self):
        self.child.send_signal(signal.SIGINT)
        code = self.child.wait(PATIENCE_S)
        assert unhandled(self.data) == []
        return code


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    folder = tmp_path_factory.mktemp("first")
    made = EmptyLab(folder)
    yield made
    if made.child.poll() is None:
        assert made.end() == 0, made.log.read_text()[-2000:]
    shutil.rmtree(folder)


class Newcomer(BenchPage):
    """Who comes to a lab in which nobody has an account."""

    def log_in(self, username):
        self.page.goto(self.demo.url)
        self.page.get_by_role("link", name="Create the first one").click()
        self.page.get_by_label("Code").fill(self.demo.code)
        self.page.get_by_label("Name").fill(username)
        self.page.get_by_label("Password").fill("a-bench-and-a-robot")
        self.page.get_by_role("button", name="Create the account").click()
        self.page.get_by_role("heading", name="First steps", level=1).wait_for()

    def step(self, title):
        """The step that is to be done has this title."""
        self.page.locator("[aria-current=step] h2", has_text=title).wait_for()

    def menu(self, name):
        self.page.locator(".bar-user > summary").click()
        self.follow(name)

    def press_button(self, name):
        self.page.get_by_role("button", name=name).click()

    def follow(self, name):
        self.page.get_by_role("link", name=name, exact=True).click()


class Recipient(BenchPage):
    """Who opens a link, is asked who they are, and is led to it."""

    def __init__(self, browser, demo, username, link):
        self.link = link
        super().__init__(browser, demo, username, WIDE)

    def log_in(self, username):
        self.page.goto(self.link)
        self.page.get_by_label("Name").fill(username)
        self.page.get_by_label("Password").fill(self.demo.passwords[username])
        self.page.click("button[type=submit]")
        self.page.wait_for_url(self.link)


def test_an_administrator_comes_by_clicking_only_to_a_first_trial_that_fails_and_shares_its_clip(
    browser, lab
):
    begun = time.monotonic()
    person = Newcomer(browser, lab, "lea", WIDE)
    scores_a_first_trial(person)
    print(f"from the address to the scored trial: {time.monotonic() - begun:.0f} s")
    shared = says_why_it_failed(person)
    shown = person.page.locator("[data-player-time]", has_text=" of ").inner_text()
    makes_an_account(person, "vera", "a-bench-and-a-viewer")
    other = Recipient(browser, lab, "vera", shared)
    other.page.locator("[data-player-time]", has_text=shown).wait_for()
    other.page.get_by_role("button", name="Play the whole recording").wait_for()  # the clip alone is played
    assert "grasp: missed" in other.page.locator(".result-summary").inner_text()
    assert (person.errors, other.errors) == ([], [])
    other.close()
    person.close()


def scores_a_first_trial(person):
    """From the empty lab, with one milestone of all reached: a failure."""
    page = person.page
    person.step("Describe a station")
    page.get_by_text("Your own robot").click()
    page.select_option("#draft-robot", "ur5e")
    page.locator("select[name='cameras.cam_wrist.kind']").select_option("v4l2")
    page.locator("input[name='cameras.cam_wrist.device']").wait_for()  # a draft asks for what its kinds need
    person.press_button("Create a simulated station")
    person.step("Check the cameras")
    pictures = page.locator("[data-live-picture]")
    eventually(
        lambda: pictures.evaluate_all("all => all.length && all.every(one => one.naturalWidth > 0)"),
        "each camera shows a picture",
        3 * PATIENCE_S,
    )
    person.press_button("Confirm the cameras")
    person.step("Home the robot")
    person.follow("Open Debug to home the robot")
    person.take_again()
    person.at_rest()
    person.press("setup")
    person.reaches("READY")
    person.menu("First steps")
    person.step("Create a first scene")
    person.press_button("Create the starter scene")
    person.step("Run and score the first trial")
    person.follow("Open Eval")
    person.take_again()
    hint = page.locator("#tour [data-tour]")
    eventually(lambda: "press Set up" in hint.inner_text(), "the page says what comes next")
    page.click("[data-prepare]")
    person.reaches("READY")
    person.press("run")
    person.reaches("RUNNING")
    clock = page.locator(".status-clock")
    eventually(lambda: re.search(r"[1-9]\d$", clock.inner_text().strip()), "the run goes on", 3 * PATIENCE_S)
    assert "Press Stop" in hint.inner_text()
    person.press("stop")
    person.reaches("READY")
    page.get_by_role("button", name="Hide hints").click()
    page.locator("#score").wait_for()
    page.locator("input[name=milestone]").first.check()
    page.locator("button[form=score]").click()
    page.locator("#score").wait_for(state="detached")
    page.reload()
    page.locator("[data-prepare]").wait_for()
    assert not hint.is_visible()  # of this browser, for good
    person.menu("First steps")
    page.get_by_role("heading", name="This lab is set up").wait_for()
    assert page.locator("[data-progress=done]").count() == 6


def says_why_it_failed(person):
    """From its clip in the gallery, by keyboard; the address of the clip."""
    page, keys = person.page, person.page.keyboard
    person.follow("Result")
    person.follow("Failures")
    card = page.locator("[data-trial]")
    eventually(
        lambda: page.reload() and card.locator("video").count(),
        "the worker has prepared its video",
        3 * PATIENCE_S,
    )
    assert card.locator("[data-why]").inner_text() == "not specified"
    eventually(
        lambda: card.locator("video").evaluate("one => one.played.length > 0"),
        "the clip plays",
        3 * PATIENCE_S,
    )
    card.locator("h3").click()
    for key, why in (("g", "grasp"), ("d", "grasp: dropped"), ("m", "grasp: missed")):
        keys.press(key)
        page.locator("#clips-said", has_text=f": {why}.").wait_for()
    card.locator("h3 a").click()
    page.wait_for_url(re.compile(r"t=.*&from=.*&to=.*loop=1"))
    return page.url


def makes_an_account(person, name, password):
    """In the administration, as it asks for it."""
    page = person.page
    person.menu("Set up a lab")
    person.follow("Add an account")
    page.get_by_label("Username").fill(name)
    page.locator("input[name=password1]").fill(password)
    page.locator("input[name=password2]").fill(password)
    page.locator("input[name=_save]").click()
    page.locator(".messagelist .success").wait_for()
    person.demo.passwords[name] = password
