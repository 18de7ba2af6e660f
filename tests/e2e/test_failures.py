"""A researcher says by keyboard why trials failed, and watches one on one clock; test_first_steps.py shares a clip."""

import json
import re

import pytest

from tests.e2e.bench_page import BenchPage
from tests.e2e.lab import WIDE
from tests.processes import PATIENCE_S, eventually
from tests.runtime.quality import built

pytestmark = pytest.mark.slow
MAKE = """
import json
from django.contrib.auth.models import User
from evaweb.episodes.models import Episode
from evaweb.episodes.reconcile import reconcile
from evaweb.stations.models import Station
from evaweb.trials import services
from evaweb.trials.models import Checkpoint, Scene, Trial
reconcile()
station, ann = Station.objects.create(name="walked", simulated=False), User.objects.get(username="ann")
checkpoint, scene = Checkpoint.objects.filter(active=True).first(), Scene.objects.filter(active=True).first()
made = []
for uuid in {uuids}:
    trial = services.prepare_trial(
        user=ann, station=station, scene=scene, position=scene.positions.first(), checkpoint=checkpoint
    )
    Trial.objects.filter(pk=trial.pk).update(status="ended", duration_s=3.0, episode=Episode.objects.get(pk=uuid))
    trial.refresh_from_db()
    keys = list(scene.milestones.values_list("pk", flat=True))
    services.score_trial(
        user=ann, trial=trial, milestones={{key: n == 0 for n, key in enumerate(keys)}}, times={{keys[0]: 1.5}}
    )
    made.append(trial.pk)
print(json.dumps(made))
"""


@pytest.fixture(scope="module")
def failed(patient):
    """Two failed trials that reached their first milestone after 1.5 of 3 s, with their recordings."""
    root = patient.data / "episodes"
    uuids = [built.record_of(root, "agilex_piper").name for _ in range(2)]
    return json.loads(patient.python(MAKE.format(uuids=uuids)).splitlines()[-1])


@pytest.fixture
def researcher(browser, patient):
    page = BenchPage(browser, patient, "ann", WIDE)
    yield page
    assert page.errors == []
    page.close()


def times(page):
    return page.locator(".result-videos video").evaluate_all("all => all.map((one) => one.currentTime)")


def test_arrow_keys_choose_a_failed_trial_letters_say_its_cause_and_each_change_can_be_undone(
    researcher, failed
):
    page, keys = researcher.page, researcher.page.keyboard
    older, newer = failed
    researcher.open("/result/")
    page.get_by_role("link", name="Failures").click()
    card = page.locator(f"[data-trial='{newer}']")
    eventually(
        lambda: page.reload() and card.locator("video").count(),
        "the worker has prepared its video",
        3 * PATIENCE_S,
    )
    eventually(
        lambda: card.locator("video").evaluate("one => one.currentTime > 0.6"),
        "the clip plays",
        3 * PATIENCE_S,
    )
    card.locator("h3").click()
    keys.press("ArrowRight")
    assert page.locator("[data-trial][aria-current]").get_attribute("data-trial") == str(older)
    keys.press("ArrowLeft")
    keys.press("g")
    keys.press("d")
    page.locator("#clips-said", has_text=f"Trial {newer}: grasp: dropped.").wait_for()
    assert card.evaluate("one => one === document.activeElement")
    keys.press("Control+z")
    eventually(lambda: card.locator("[data-why]").inner_text() == "grasp", "the cause is taken back")
    keys.press("m")
    eventually(lambda: card.locator("[data-why]").inner_text() == "grasp: missed", "another one is said")
    reasons = [score["reason"] for score in researcher.api(f"trials/{newer}")["scores"]]
    assert reasons[0] == "failure was grasp, now grasp: missed"
    assert len(reasons) == 5  # the first score, three changes, one undone
    page.select_option("select[name=group]", "position")
    page.wait_for_url(re.compile("group=position"))
    assert page.locator(f"[data-trial='{newer}'] [data-why]").inner_text() == "grasp: missed"


def test_all_cameras_of_a_trial_follow_one_clock_and_a_milestone_leads_to_its_moment(researcher, failed):
    page, keys = researcher.page, researcher.page.keyboard
    researcher.open(f"/result/trials/{failed[0]}/")
    shown = page.locator("[data-player-time]")
    eventually(
        lambda: page.reload() and page.locator("[data-player]").is_visible(),
        "it can be played",
        3 * PATIENCE_S,
    )
    row = 1 / built.FPS

    def within_one_row():
        found = times(page)
        return max(found) - min(found) <= row

    keys.press("1")
    shown.filter(has_text="1.50 of 3.00 s").wait_for()
    eventually(lambda: all(abs(at - 1.5) <= row for at in times(page)), "all show the milestone's moment")
    page.wait_for_url(re.compile(r"\?t=1\.5$"))
    keys.press("ArrowRight")
    shown.filter(has_text=f"{1.5 + row:.2f} of").wait_for()
    page.locator("[data-player-slider]").fill("30")
    eventually(lambda: all(abs(at - 30 * row) <= row for at in times(page)), "all are where the slider is")
    page.select_option("[data-player-speed]", "0.25")
    page.locator("[data-player-play]").click()
    eventually(lambda: min(times(page)) > 34 * row, "all play", 3 * PATIENCE_S)
    eventually(within_one_row, "they are within a row of each other")
    keys.press("Escape")
    page.locator("h1").click()
    keys.press(" ")
    page.get_by_role("button", name="Play", exact=False).first.wait_for()
    page.locator("a[data-seek]").click()
    shown.filter(has_text="1.50 of 3.00 s").wait_for()
