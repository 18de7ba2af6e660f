"""What the machine spoilt is run again, and nothing else: a pytest of its own, whose tests say how they go."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from tests.processes import PATIENCE_S
from tests.stalls import GAP_S, TRY, Watch

ROOT = Path(__file__).parents[1]
_CONFTEST = """
import json, os, pathlib, sys
sys.path.insert(0, {root!r})
from tests.stalls import Stalls
TRIES = pathlib.Path(__file__).with_name("tries")
class Told:
    def since(self, moment):
        return tuple(json.loads(os.environ["GAP"])) if os.environ["GAP"] else None
    def close(self):
        pass
def pytest_configure(config):
    config.addinivalue_line("markers", "story: one")
    config.pluginmanager.register(Stalls(Told()))
"""
_TESTS = """
import os, pathlib, pytest
@pytest.mark.story
def test_one():
    with pathlib.Path(__file__).with_name("tries").open("a") as file:
        file.write("x")
    assert int(os.environ.get("EVA_TESTS_TRY", "1")) >= int(os.environ["PASSES_AT"])
"""


_WRONG = """
def test_wrong():
    raise AssertionError("never right")
"""


def run(folder, gap, passes_at, *options, more=""):
    (folder / "conftest.py").write_text(_CONFTEST.format(root=str(ROOT)))
    (folder / "test_it.py").write_text(_TESTS)
    if more:
        (folder / "test_more.py").write_text(more)
    environment = {name: value for name, value in os.environ.items() if name != TRY}
    environment |= {"GAP": json.dumps(gap) if gap else "", "PASSES_AT": str(passes_at)}
    (folder / "pytest.ini").write_text("[pytest]\naddopts = -p no:django -p no:cacheprovider\n")
    files = ["test_it.py", *(["test_more.py"] if more else [])]
    command = [sys.executable, "-m", "pytest", *(options or ("-m", "story")), *files]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=PATIENCE_S
    )
    return done.returncode, len((folder / "tries").read_text()), done.stdout


@pytest.mark.exhaustive
def test_a_failure_without_a_gap_stays_one_and_is_not_run_again(tmp_path):
    code, tries, said = run(tmp_path, None, 2)
    assert (code, tries) == (1, 1)
    assert "1 failed" in said


def test_what_failed_across_a_gap_is_invalid_and_decided_by_the_next_run(tmp_path):
    code, tries, said = run(tmp_path, (1.0, 3.5), 2)
    assert (code, tries) == (0, 2), said
    assert "test_one: the machine stood still for 2.5 s" in said
    assert "1 invalid" in said
    assert "1 failed" not in said


@pytest.mark.exhaustive
def test_it_is_said_what_an_invalid_one_failed_of(tmp_path):
    _, _, said = run(tmp_path, (1.0, 3.5), 2)
    assert 'int(os.environ.get("EVA_TESTS_TRY", "1")) >= ' in said


@pytest.mark.exhaustive
def test_a_failure_of_what_is_no_story_stays_one_whatever_the_machine_did(tmp_path):
    code, _, said = run(tmp_path, (1.0, 3.5), 2, "-v", more=_WRONG)
    assert code == 1
    assert "1 failed, 1 invalid" in said


@pytest.mark.exhaustive
def test_a_session_that_was_ended_by_an_invalid_one_is_not_green(tmp_path):
    two = _TESTS.replace("test_one", "test_two")
    code, _, said = run(tmp_path, (1.0, 3.5), 2, "-x", "-m", "story", more=two)
    assert code == 1
    assert "test_two" not in said


@pytest.mark.exhaustive
def test_what_is_invalid_a_third_time_is_an_error_of_its_own(tmp_path):
    code, tries, said = run(tmp_path, (1.0, 3.5), 9)
    assert (code, tries) == (1, 3)
    assert said.count("1 invalid") == 3


def test_a_process_that_is_stopped_for_a_while_is_noticed_and_one_that_is_not_is_not():
    watch = Watch()
    begun = time.monotonic()
    watcher = psutil.Process(watch.pid)
    watcher.send_signal(signal.SIGSTOP)
    time.sleep(2 * GAP_S)
    watcher.send_signal(signal.SIGCONT)
    gap = watch.since(begun)
    assert gap is not None

    assert gap[1] - gap[0] > GAP_S
    assert watch.since(time.monotonic() + PATIENCE_S) is None
    watch.close()
