"""A blind plan carried out by the script in lockstep, as the README has it."""

import json
import subprocess
import sys

import pytest

from tests.e2e.conftest import SETS
from tests.e2e.lab import ROOT, environment

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(400),
]


def test_two_blind_trials_are_made_revealed_and_compared(tmp_path):
    out = tmp_path / "out.json"
    done = subprocess.run(
        [sys.executable, "manage.py", "demo", "--port", "0", "--evaluate", "2", "--json", str(out), *SETS],
        cwd=ROOT,
        env=environment(tmp_path / "data"),
        capture_output=True,
        text=True,
        timeout=350,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(out.read_text())
    trials = found["trials"]
    assert {trial["checkpoint"] for trial in trials} == {
        "pick-place-40k-by-script",
        "pick-place-8k-by-script",
    }
    assert len({trial["code"] for trial in trials}) == 2
    assert len({trial["position"] for trial in trials}) == 1  # one block: the same condition for both
    assert found["lockstep"] is True
    for trial in trials:  # its own time: whole ticks of 30 Hz, and nothing was reached after its end
        assert trial["duration_s"] * 30 == pytest.approx(round(trial["duration_s"] * 30), abs=1e-6)
        assert all(0 < at <= trial["duration_s"] for at in trial["times"].values())
        assert trial["success"] == ("placed" in trial["times"])
    assert found["commitment"] in done.stderr
    assert len(bytes.fromhex(found["key"])) == 32
    assert [arm["success"]["n"] for arm in found["analysis"]["arms"]] == [1, 1]
    assert "Barnard p" in done.stdout
    assert not any(trial["checkpoint"] in done.stderr for trial in trials)
