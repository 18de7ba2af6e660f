"""The worker as a process: works with and without its doorbell, and ends when it is told or left alone."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests import migrated
from tests.processes import PATIENCE_S

ROOT = Path(__file__).parents[3]
pytestmark = pytest.mark.slow

# A kind of job that says that it has begun and then takes as long as its file is there.
KIND = """
import time
from pathlib import Path
from evaweb.jobs.kinds import job_kind

@job_kind("wait")
def wait(work):
    Path(work.args["begun"]).write_text("begun")
    while Path(work.args["hold"]).exists():
        time.sleep(0.02)
    return {"done": True}
"""


class Lab:
    """A data folder with a database, and processes on it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        code = folder / "code"
        code.mkdir()
        (code / "waiting.py").write_text(KIND)
        (code / "manage_waiting.py").write_text(
            "import sys, os\n"
            f"sys.path[:0] = [{str(ROOT)!r}, {str(code)!r}]\n"
            "os.environ['DJANGO_SETTINGS_MODULE'] = 'evaweb.settings'\n"
            "import django; django.setup()\n"
            "import waiting\n"
            "from django.core.management import execute_from_command_line\n"
            "execute_from_command_line(sys.argv)\n"
        )
        self.manage_py = code / "manage_waiting.py"
        self.begun, self.hold = folder / "begun", folder / "hold"
        self.environment = {
            **{name: value for name, value in os.environ.items() if name != "DJANGO_SETTINGS_MODULE"},
            "EVA_DATA_DIR": str(folder),
            "EVA_SECRET_KEY": "for tests alone",
            "EVA_WORKER_GRACE_S": "0.3",
            "EVA_WORKER_NICE": "0",  # beside other tests it would hardly be run
            "EVA_JOB_STALE_S": "3600",  # an ended worker of this machine is not waited for
        }
        self.workers: list[subprocess.Popen[bytes]] = []

    def manage(self, *arguments: str) -> str:
        done = subprocess.run(
            [sys.executable, str(self.manage_py), *arguments],
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    def ask(self) -> None:
        code = (
            "import waiting; from evaweb.jobs.services import enqueue; "
            f"enqueue(kind='wait', key='wait', args={{'begun': {str(self.begun)!r}, 'hold': {str(self.hold)!r}}})"
        )
        self.manage("shell", "--no-imports", "-c", code)

    def worker(self) -> subprocess.Popen[bytes]:
        with (self.folder / "worker.log").open("ab") as log:
            made = subprocess.Popen(
                [sys.executable, str(self.manage_py), "worker", "--lifeline"],
                env=self.environment,
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
            )
        self.workers.append(made)
        return made

    def until(self, reached: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not reached():
            assert time.monotonic() < deadline, f"{what}: {(self.folder / 'worker.log').read_text()}"
            time.sleep(0.05)

    def job(self) -> tuple[str, int, int]:
        """Status, attempts and deaths of the job."""
        with sqlite3.connect(self.folder / "eva.sqlite3", timeout=PATIENCE_S) as database:
            found = database.execute(
                "select status, attempts, deaths from jobs_job where key = 'wait'"
            ).fetchone()
        return (str(found[0]), int(found[1]), int(found[2]))


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    made = Lab(tmp_path)
    migrated.copy(tmp_path)
    yield made
    for worker in made.workers:
        if worker.poll() is None:
            worker.kill()
        worker.wait()
        assert worker.stdin is not None
        worker.stdin.close()


@pytest.mark.exhaustive
def test_a_job_asked_for_before_the_worker_and_with_no_broker_is_done_and_the_lifeline_ends_it(
    lab: Lab,
) -> None:
    (lab.folder / "broker").write_text("in the way of every doorbell")
    lab.ask()
    del lab.environment["EVA_WORKER_NICE"]
    worker = lab.worker()
    lab.until(lambda: lab.job()[0] == "done", "the job is done")
    assert os.getpriority(os.PRIO_PROCESS, worker.pid) == 19
    assert worker.stdin is not None
    worker.stdin.close()
    assert worker.wait(PATIENCE_S) == 0


@pytest.mark.exhaustive
def test_told_to_end_it_finishes_its_job_or_puts_it_back_and_after_a_kill_another_one_takes_it(
    lab: Lab,
) -> None:
    lab.hold.write_text("on")
    lab.ask()
    first = lab.worker()
    lab.until(lab.begun.exists, "the job begins")
    first.send_signal(signal.SIGTERM)
    assert first.wait(PATIENCE_S) == 0
    assert lab.job() == ("queued", 0, 0), "it was put back as if it had never been claimed"

    lab.begun.unlink()
    second = lab.worker()
    lab.until(lab.begun.exists, "the job begins again")
    second.kill()
    second.wait()
    assert lab.job() == ("running", 0, 0), "a killed worker says nothing"

    lab.begun.unlink()
    lab.environment["EVA_WORKER_GRACE_S"] = "60"
    third = lab.worker()
    lab.until(lab.begun.exists, "the job is swept and begins once more")
    third.send_signal(signal.SIGTERM)
    lab.hold.unlink()
    assert third.wait(PATIENCE_S) == 0
    assert lab.job() == ("done", 0, 1)
