"""A second person rates trials again from their videos, and says which of two was better."""

import pytest

from tests.e2e.bench_page import BenchPage
from tests.e2e.lab import WIDE
from tests.processes import PATIENCE_S, eventually
from tests.runtime.quality import built

pytestmark = pytest.mark.slow
MAKE = """
from django.contrib.auth.models import User
from evaweb.episodes.models import Episode
from evaweb.episodes.reconcile import reconcile
from evaweb.plans.allocation import allocate_trial
from evaweb.plans.models import Plan
from evaweb.plans.services import freeze_plan
from evaweb.stations.models import Station
from evaweb.trials import services
from evaweb.trials.models import Checkpoint, Scene, Trial
reconcile()
station, ann = Station.objects.create(name="judged", simulated=False), User.objects.get(username="ann")
scene = Scene.objects.filter(active=True).first()
plan = Plan.objects.create(name="judged", title="Judged", owner=ann, blind=False, second_rater_share=1.0)
plan.checkpoints.set(Checkpoint.objects.filter(active=True)[:2])
plan.positions.set([scene.positions.first()])
plan = freeze_plan(user=ann, plan=plan)
for uuid in {uuids}:
    trial = allocate_trial(user=ann, station=station, plan=plan).trial
    Trial.objects.filter(pk=trial.pk).update(status="ended", duration_s=3.0, episode=Episode.objects.get(pk=uuid))
    trial.refresh_from_db()
    ticks = dict.fromkeys(scene.milestones.values_list("pk", flat=True), True)
    services.score_trial(user=ann, trial=trial, milestones=ticks)
Station.objects.filter(pk=station.pk).update(active=False)
"""


@pytest.fixture
def rater(browser, patient):
    """Somebody who ran none of two trials that were scored as successes."""
    uuids = [built.record_of(patient.data / "episodes", "agilex_piper").name for _ in range(2)]
    patient.python(MAKE.format(uuids=uuids))
    page = BenchPage(browser, patient, "operator", WIDE)
    yield page
    assert page.errors == []
    page.close()


def test_trials_are_rated_again_and_compared_from_their_videos_without_the_first_score(rater, patient):
    page, keys = rater.page, rater.page.keyboard
    ready = page.locator("[data-player]")
    rater.open("/result/")
    page.get_by_role("link", name="Second ratings").click()
    for left in (2, 1):
        page.get_by_text(f"{left} left for you").wait_for()
        eventually(lambda: page.reload() and ready.is_visible(), "its videos can be watched", 3 * PATIENCE_S)
        assert "success" not in page.locator("form.judge-form .check").first.inner_text()
        keys.press("ArrowRight")
        page.locator("[data-player-time]", has_text=f"{1 / built.FPS:.2f} of").wait_for()
        page.locator("input[name=milestone]").first.check()
        page.get_by_role("button", name="Save and continue").click()
    page.get_by_text("Nothing is left for you to rate.").wait_for()

    page.get_by_role("link", name="Pairwise preference").click()
    page.get_by_text("1 pair left for you").wait_for()
    assert page.locator(".judge-pair section").count() == 2
    ready.wait_for()
    page.get_by_role(
        "button", name="Save and continue"
    ).click()  # which a browser does not do: nothing is said yet
    page.locator("label.choice").first.click()
    page.get_by_label("Why").fill("it does not shake")
    page.get_by_role("button", name="Save and continue").click()
    page.get_by_text("No pair is left for you to compare.").wait_for()
    assert patient.rows("SELECT success FROM results_rating") == [(0,), (0,)]
    assert patient.rows("SELECT why FROM results_preference") == [("it does not shake",)]
    scored = "SELECT s.success FROM trials_score s JOIN plans_handout h ON h.trial_id = s.trial_id"
    assert patient.rows(scored) == [(1,), (1,)]  # what others say later changes no score
