"""Every benchmark in its smallest form: it comes to its end and says figures, however good they are here."""

import json
import subprocess
import sys

import pytest

from benchmarks.__main__ import _BENCHMARKS
from tests.processes import PATIENCE_S
from tests.sources import ROOT


@pytest.mark.lab
@pytest.mark.parametrize("name", _BENCHMARKS)
def test_it_comes_to_its_end(name, tmp_path):
    told = tmp_path / "figures.json"
    command = [sys.executable, "-m", "benchmarks", name, "--seconds", "1", "--json", str(told)]
    if name == "estop":  # each attack is a lab of its own: tests/benchmarks/test_estop.py
        code = "import pathlib, sys; from benchmarks.estop import measure; "
        code += "measure(1.0, ['none']).write(pathlib.Path(sys.argv[1]))"
        command = [sys.executable, "-c", code, str(told)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=20 * PATIENCE_S)
    assert done.returncode in (0, 1), done.stderr[-3000:]
    assert "Traceback" not in done.stderr, done.stderr[-3000:]
    assert json.loads(told.read_text())["figures"]
