"""Every benchmark in its smallest form: it comes to its end and says figures, however good they are here."""

import json
import subprocess
import sys

import pytest

from benchmarks.__main__ import _BENCHMARKS
from tests.e2e.lab import environment
from tests.processes import PATIENCE_S
from tests.sources import ROOT

# What counts cases, and not seconds: fewer of them. Each attack on the e-stop is a lab of its own in test_estop.py.
OPTIONS = {
    "estop": {"attacks": ["none"]},
    "pages": {"plans": 2, "trials": 40},
}
FEWER = {
    "contact": {"contact.SEEDS": 1, "contact.DEPLOYMENTS": {"ur5e": "tabletop_ur5e"}},
    "glass": {"glass._MARGIN_S": 0.2},
    "lab": {"climb.RUNGS": [1, 2], "climb._MOST_VIEWERS": 10, "lab._CUTS": 2, "lab._UPLOAD_MB": 50},
    "loop": {"loop.RATES": [30.0]},
    "measures": {"measures._VARIANTS": ["", "fifo"]},
    "moving_target": {"moving_target.SEEDS": 1, "moving_target.DELAYS": [8]},
    "pages": {"pages.LOADS": 1, "pages._LATER_MS": 100},
    "partial_credit": {"partial_credit.RUNS": 5, "partial_credit.PAIRS": 10},
    "recording": {
        "recording._KILLED_S": [1.0, 1.0],
        "recording._LEAST_KILLS": [4, 1],  # each process once
        "recording._BESIDE_S": 2.0,
        "recording._LISTED": 300,
    },
    "replay": {"replay._AGAIN": 1},
    "start": {"start._STARTS": 1},
    "strategies": {
        "moving_target.SEEDS": 1,
        "moving_target.DELAYS": [8],
        "strategies.CONTROLS": [30.0],
        "strategies.DELAYS": [3],
        "strategies.RATES": [3.0],
    },
    "wires": {"wires_policies._ROUNDS": 1},
}
CODE = """
import importlib, json, pathlib, sys
name, fewer, options, told = sys.argv[1:]
for what, value in json.loads(fewer).items():
    module, _, key = what.partition(".")
    assert hasattr(importlib.import_module(f"benchmarks.{module}"), key), what
    setattr(importlib.import_module(f"benchmarks.{module}"), key, value)
if __name__ == "__main__":  # and not in a process that it starts
    importlib.import_module(f"benchmarks.{name}").measure(1.0, **json.loads(options)).write(pathlib.Path(told))
"""


# What is no lab is made beside other tests; those that another test makes whole are not made twice.
COMPUTED = ("contact", "ik", "moving_target", "partial_credit", "strategies")
ELSEWHERE = (
    "coverage",
    "designs",
    "results",
    "soak",
)  # test_coverage, test_designs, test_results, test_fuzzing
EVERY = [
    pytest.param(name, marks=pytest.mark.exhaustive if name in COMPUTED else pytest.mark.lab)
    for name in _BENCHMARKS
    if name not in ELSEWHERE
]


@pytest.mark.parametrize("name", EVERY)
def test_it_comes_to_its_end(name, tmp_path):
    told = tmp_path / "figures.json"
    if name in OPTIONS or name in FEWER:
        fewer, options = json.dumps(FEWER.get(name, {})), json.dumps(OPTIONS.get(name, {}))
        command = [sys.executable, "-c", CODE, name, fewer, options, str(told)]
    else:
        command = [sys.executable, "-m", "benchmarks", name, "--seconds", "1", "--json", str(told)]
    done = subprocess.run(
        command,
        cwd=ROOT,
        env=environment(tmp_path / "data"),
        capture_output=True,
        text=True,
        timeout=20 * PATIENCE_S,
    )
    assert done.returncode in (0, 1), done.stderr[-3000:]
    assert "Traceback" not in done.stderr, done.stderr[-3000:]
    assert told.exists(), done.stderr[-3000:]
    assert json.loads(told.read_text())["figures"]
