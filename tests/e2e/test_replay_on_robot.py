"""What was recorded is played on the simulated robot from the browser: set up, approached, run to its last row."""

import time

import pytest

from runtime.datasets.finished_episode import read_finished_episode
from runtime.datasets.publishing import publish
from tests.e2e.by_hand import DebugPage
from tests.e2e.lab import STATION, WIDE
from tests.processes import PATIENCE_S, eventually
from tests.runtime.quality import built

pytestmark = pytest.mark.slow
ROBOT, ROWS = "agilex_piper", 45
AWAY = 0.4  # rad, of the first joint, so that there is a way to the first row


def swing(index, fields):
    fields["action"][0] += AWAY


@pytest.fixture(scope="module")
def recorded(patient):
    """An episode on the disk of the lab, and the same in a dataset: where each is in Replay; its actions."""
    root = patient.data / "episodes"
    folder = built.record_of(root, ROBOT, swing, ROWS, started_wall=time.time(), station=STATION)
    publish(folder, patient.data / "datasets" / "swings", success=True)
    patient.python("from evaweb.episodes.reconcile import reconcile; reconcile()")
    actions = read_finished_episode(folder).finite_vectors("action")
    return {"recording": f"/replay/{folder.name}/", "dataset": "/replay/datasets/swings/-/0/"}, actions


@pytest.fixture(scope="module")
def operator(browser, patient):
    page = DebugPage(browser, patient, "operator", WIDE)
    yield page
    assert page.errors == []
    page.close()


@pytest.mark.parametrize("kind", ["recording", pytest.param("dataset", marks=pytest.mark.story)])
def test_it_is_set_up_approached_and_run_to_its_last_row(operator, patient, recorded, kind):
    places, actions = recorded
    page = operator.open(places[kind]).page
    on_robot = page.get_by_role("link", name="Run on the robot")
    eventually(on_robot.is_visible, "the episode is prepared", 3 * PATIENCE_S)
    on_robot.click()
    page.locator(f"[data-station={STATION}] a").click()
    page.locator("#replay").wait_for()
    operator.take_again()
    operator.set_up()
    page.locator("[data-mode=far]").wait_for()  # the pose of the set-up is not that of the first row
    operator.press("approach")
    operator.quiet("[data-mode=far]")
    operator.reaches("READY")
    first = operator.snapshot()["facts"]["joint_names"].index("left_arm.joint0")
    assert operator.joints()[first] == pytest.approx(actions[:5, first].mean(), abs=0.05)

    before = operator.snapshot()["last_run"]
    operator.press("run")
    eventually(lambda: operator.snapshot()["last_run"] != before, "the run is over")
    run = operator.snapshot()["last_run"]
    assert "are over" in run["reason"]
    operator.reaches("READY")
    count = len(operator.joints())
    last = pytest.approx(actions[-1, :count], abs=0.02)
    eventually(lambda: operator.joints() == last, f"the page shows the robot at {last}")
    played = executed(patient.data / "episodes" / run["uuid"])
    assert played[:, first].max() == pytest.approx(actions[:, first].max(), abs=0.01)
    assert played[-1] == pytest.approx(actions[-1], abs=1e-3)


def executed(folder):
    """The actions [N, D] of the run that was recorded there."""
    eventually((folder / "outcome.json").exists, "its recording has ended")
    return read_finished_episode(folder).finite_vectors("action")
