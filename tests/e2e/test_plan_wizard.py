"""A plan made by clicking only, from the stations on: drafted step by step, frozen, and its first trial handed out."""

import re

import pytest

from tests.e2e.bench_page import BenchPage
from tests.e2e.lab import STATION, WIDE
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.slow
ARMS = ("pick-place-40k", "pick-place-8k")
TITLE = "40k against 8k"


def step(page, name):
    """The step is shown, alone, after what leads to it was pressed."""
    page.get_by_role("link", name=f"Next: {name}").locator("visible=true").click()
    page.get_by_role("heading", name=name, exact=True).wait_for()
    assert page.locator(".draft-step:visible").count() == (2 if name == "Design" else 1)


def found(page, trials):
    """In how many of 100 evaluations a difference is found, with so many trials of each."""
    said = page.locator("#power", has_text=f"With {trials} trials of each").locator("p", has_text="of 100")
    said.wait_for()
    page.locator("#power svg.power").wait_for()
    return int(re.search(r"in (\d+) of 100", said.inner_text())[1])


def drafted(page):
    """A draft with two arms at all positions of the demo's scene; the power is watched while its size changes."""
    page.get_by_role("link", name="Result", exact=True).click()
    page.get_by_role("link", name="Evaluations", exact=True).click()
    page.get_by_role("link", name="New plan").click()
    page.get_by_label("Name of the plan").fill(TITLE)
    page.get_by_label("Question").fill("Does longer training help?")
    page.get_by_role("button", name="Create the draft").click()
    page.get_by_role("heading", name="Checkpoints", exact=True).wait_for()
    for name in ARMS:
        page.locator(".draft-arm", has_text=name).get_by_role("checkbox").check()
    page.get_by_role("radio", name=f"Control: {ARMS[1]}").check()
    step(page, "Conditions")
    page.get_by_role("button", name="All positions of Block on plate").click()
    step(page, "Design")
    page.get_by_role("radio", name="Group sequential late").check()
    page.get_by_label("Trials of each checkpoint at each position").fill("5")
    few = found(page, 20)
    page.get_by_label("Trials of each checkpoint at each position").fill("20")
    assert found(page, 80) > few + 20
    page.get_by_label("Of the other checkpoint").fill("0.55")
    eventually(lambda: found(page, 80) < few, "another assumption gives another power", 3 * PATIENCE_S)
    page.get_by_label("Trials of each checkpoint at each position").fill("2")
    found(page, 8)


def test_a_plan_is_made_by_clicking_and_its_first_trial_is_handed_out(browser, patient):
    researcher = BenchPage(browser, patient, "admin", WIDE).open("/")
    page = researcher.page
    drafted(page)
    page.reload()
    page.get_by_role("heading", name="Design", exact=True).wait_for()
    assert page.get_by_label("Trials of each checkpoint at each position").input_value() == "2"
    step(page, "Schedule")
    assert page.locator("#schedule li", has_text="order drawn at freezing").count() == 6
    page.go_back()
    page.get_by_role("heading", name="Design", exact=True).wait_for()
    page.go_forward()
    step(page, "Checks")
    page.locator("#checks", has_text="No digest of the weights").get_by_role(
        "link", name="Change it"
    ).first.click()
    page.get_by_role("heading", name="Checkpoints", exact=True).wait_for()
    page.locator(".draft-preflight .preflight").nth(1).wait_for()  # what is known of the servers of both
    page.get_by_role("navigation", name="Steps").get_by_role("link", name="Freeze").click()
    page.get_by_role("button", name="Freeze this plan").click()
    page.get_by_role("button", name=f"Freeze “{TITLE}”").click()
    page.locator(".chip", has_text="running").wait_for()
    assert researcher.errors == []
    researcher.close()

    operator = BenchPage(browser, patient, "ann", WIDE).open(f"/stations/{STATION}/eval/")
    page = operator.page
    operator.at_rest()
    operator.take_again()
    page.select_option("#plan-choice", label=f"{TITLE}, blind")
    page.locator("[data-confirm-cameras]").click()
    page.locator("[data-next]:not([aria-disabled=true])").click()
    assert len(page.locator(".plan-code").inner_text()) == 5
    operator.reaches("READY")
    panel = page.locator("#panel").inner_text()
    assert not any(name in panel for name in ARMS)
    assert operator.errors == []
    operator.close()
