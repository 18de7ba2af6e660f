"""`manage.py evaluate`: a plan is carried out without people, killed and continued."""

import subprocess
import sys

import pytest

from tests.e2e.conftest import LOCKSTEP
from tests.e2e.lab import ROOT, STATION, Demo
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.slow
PLAN = "block-on-plate-blind"
COUNTED = "SELECT count(*) FROM trials_trial WHERE status = 'scored'"


@pytest.fixture
def lab(tmp_path):
    lab = Demo(tmp_path, *LOCKSTEP).start()
    yield lab
    assert lab.end() == 0


def evaluating(lab, *options, plan=PLAN):
    return subprocess.Popen(
        [
            sys.executable,
            "manage.py",
            "evaluate",
            plan,
            "--station",
            STATION,
            "--url",
            lab.url,
            "--lockstep",
            *options,
        ],
        cwd=ROOT,
        env=lab.environment | {"EVA_PASSWORD": lab.passwords["operator"]},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finished(child):
    out, err = child.communicate(timeout=6 * PATIENCE_S)
    return child.returncode, out, err


def test_a_plan_goes_on_after_its_program_was_killed(lab):
    killed = evaluating(lab)
    eventually(
        lambda: lab.rows("SELECT 1 FROM trials_trial WHERE status = 'running'"),
        "a trial runs",
        3 * PATIENCE_S,
    )
    killed.kill()
    killed.communicate()
    before = lab.rows(COUNTED)[0][0]
    code, out, err = finished(evaluating(lab, "--trials", "1"))
    assert code == 0, err
    assert lab.rows(COUNTED)[0][0] >= before + 1
    assert "trials are left" in out
    assert "pick-place" not in out  # the plan stays blind for who carries it out
    assert not lab.rows(
        "SELECT 1 FROM trials_trial WHERE status IN ('prepared', 'running', 'paused', 'ended')"
    )


def test_copies_of_the_station_carry_out_trials_beside_it(lab):
    child = subprocess.Popen(
        [
            *(sys.executable, "manage.py", "evaluate", PLAN),
            *("--station", STATION, "--copies", "2", "--trials", "2"),
        ],
        cwd=ROOT,
        env=lab.environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    code, out, err = finished(child)
    assert code == 0, err
    assert "pick-place" not in out
    rows = lab.rows("SELECT status, attempt, worker IS NOT NULL, episode_id IS NOT NULL FROM trials_trial")
    assert rows == [("scored", 1, 1, 1)] * 2
    assert not list((lab.data / "farm" / "trials").iterdir())
    recorded = {path.name for path in (lab.data / "episodes").iterdir() if not path.name.startswith(".")}
    assert len(recorded) == 2


def test_what_cannot_be_carried_out_is_said(lab):
    code, _, err = finished(evaluating(lab, plan="moon"))
    assert code != 0
    assert "moon" in err
    lab.python(
        f"from evaweb.stations.models import Station; Station.objects.filter(name='{STATION}').update(simulated=False)"
    )
    code, _, err = finished(evaluating(lab))
    assert code != 0
    assert "has a real robot" in err
