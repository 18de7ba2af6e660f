import subprocess
import sys

import pytest

from tests.sources import ROOT


@pytest.mark.some(1)
@pytest.mark.parametrize(
    ("old", "new", "arguments"),
    [
        ("runtime.config_reference", "runtime.config.reference", []),
        ("runtime.channel", "runtime.clients.channel", ["--help"]),
    ],
)
def test_an_old_name_goes_on_with_a_warning(old, new, arguments):
    def run(name):
        command = [sys.executable, "-m", name, *arguments]
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)

    before, now = run(old), run(new)
    assert before.stdout == now.stdout != ""
    assert (before.stderr, now.stderr) == (f"python -m {old} is now called python -m {new}\n", "")
