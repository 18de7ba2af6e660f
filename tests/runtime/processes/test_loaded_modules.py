"""What each process loads, which no linter sees where modules are imported by name."""

import subprocess
import sys

import pytest

from tests.sources import ROOT


def loaded(module):
    """Names of all modules that are there once `module` is imported."""
    code = f"import sys, {module}; print(*sorted(sys.modules))"
    told = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    return told.stdout.split()


def test_the_guard_loads_core_and_ipc_alone():
    ours = {
        name
        for name in loaded("runtime.processes.guard.process")
        if name.partition(".")[0] in ("runtime", "robots")
    }
    below = ("runtime.core", "runtime.ipc", "runtime.processes.guard")
    assert "runtime.ipc.estop_latch" in ours
    assert {name for name in ours if not name.startswith(below)} == {"runtime", "runtime.processes"}


@pytest.mark.parametrize(
    "module",
    [
        "runtime.config.schema",
        "runtime.processes.control.process",
        "runtime.processes.reception.process",
        "runtime.processes.guard.process",
        "runtime.ctl",
    ],
)
def test_what_stops_a_robot_is_free_of_codecs_and_tables(module):
    assert not {"av", "pyarrow", "PIL", "websockets", "simplejpeg"} & set(loaded(module))
