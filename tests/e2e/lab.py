"""A whole demo lab of real processes on a free port, and a real browser that looks at it."""

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from contextlib import closing, contextmanager
from pathlib import Path

import psutil

from tests import migrated
from tests.processes import PATIENCE_S, alive, eventually

ROOT = Path(__file__).parents[2]
CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"
NO_CHROMIUM = "Debian's chromium is not installed (apt-get install chromium)"
STATION = "bench-1"
DEAD = "dead-policy"
_MORE = f"""
import json
from evaweb.lab.demo_rows import demo_checkpoint, demo_login
from evaweb.accounts.roles import Role
people = [demo_login(username="ann", role=Role.OPERATOR), demo_login(username="visitor", role=Role.VIEWER)]
demo_checkpoint(name="{DEAD}", description="", policy={{"url": "ws://127.0.0.1:1"}})
print(json.dumps({{login.username: login.password for login in people}}))
"""
WIDE, TABLET = {"width": 1440, "height": 900}, {"width": 1024, "height": 768}


class Demo:
    """`manage.py demo` in a data folder of its own; `settings` go into its environment."""

    def __init__(self, folder, *options, **settings):
        self.folder = folder
        self.data = folder / "data"
        self.environment = environment(self.data) | settings
        self._options = options

    def start(self):
        """Start it and wait until it is up; returns itself."""
        if not self.data.exists():
            migrated.copy(self.data)
        ready = self.folder / "ready.json"
        ready.unlink(missing_ok=True)
        self.output = (self.folder / "demo.log").open("a")
        self.child = subprocess.Popen(
            [sys.executable, "manage.py", "demo", "--port", "0", "--ready-file", str(ready), *self._options],
            cwd=ROOT,
            env=self.environment,
            stdout=self.output,
            stderr=self.output,
        )

        def up():
            assert self.child.poll() is None, (self.folder / "demo.log").read_text()[-2000:]
            return ready.exists()

        try:
            eventually(up, "the demo is up", 3 * PATIENCE_S)
        except BaseException:
            self.child.kill()  # all that it started ends with it
            raise
        found = json.loads(ready.read_text())
        self.url, self.passwords, self.pids = found["url"], found["passwords"], found["pids"]
        return self

    def people(self):
        """Add an operator, a viewer, and a checkpoint that nobody serves; returns itself."""
        self.passwords |= json.loads(self.python(_MORE))
        return self

    @property
    def runs(self):
        return self.child.poll() is None

    def pid(self, word):
        """The program of the lab that has `word` among its arguments, as it runs now."""
        own = psutil.Process(self.child.pid).children()
        found = [child.pid for child in own if alive(child.pid) and word in child.cmdline()]
        assert len(found) == 1, f"{len(found)} programs of the lab have {word!r} among their arguments"
        return found[0]

    def everyone(self):
        """All processes of this lab, but for the one that we started."""
        return psutil.Process(self.child.pid).children(recursive=True)

    def python(self, program):
        """What a Python program says that runs in this lab's Django, beside its own processes."""
        run = [sys.executable, "manage.py", "shell", "--verbosity", "0", "--command", program]
        return subprocess.run(
            run, cwd=ROOT, env=self.environment, check=True, capture_output=True, text=True
        ).stdout

    def rows(self, question, *values):
        """What the database has, read past everything."""
        with closing(sqlite3.connect(self.data / "eva.sqlite3")) as database:
            return database.execute(question, values).fetchall()

    @contextmanager
    def locked(self):
        """The database, held by somebody who writes and writes."""
        with closing(sqlite3.connect(self.data / "eva.sqlite3", isolation_level=None)) as database:
            database.execute("PRAGMA busy_timeout = 20000")
            database.execute("BEGIN IMMEDIATE")
            yield
            database.execute("ROLLBACK")

    def end(self, number=signal.SIGINT):
        """End it as a person would; returns the exit code."""
        if self.runs:
            self.child.send_signal(number)
        code = self.child.wait(PATIENCE_S)
        self.output.close()
        assert unhandled(self.data) == []
        return code


def unhandled(data):
    """The first exception in the log of each process of a lab that serves people, with what stands around it."""
    found = []
    for name in ("web", "stops", "gate"):
        path = data / "logs" / f"{name}.log"
        before, mark, after = (path.read_text(errors="replace") if path.exists() else "").partition(
            "Traceback (most recent call last)"
        )
        found += [before[-300:] + mark + after[:3000]] if mark else []
    return found


def left(processes):
    """Those that have not ended."""
    return [process for process in processes if process.is_running() and alive(process.pid)]


def environment(data):
    """What a lab of the tests is started with: nothing of the settings that the tests themselves run on."""
    ours = {key: value for key, value in os.environ.items() if not key.startswith(("EVA_", "DJANGO_"))}
    return ours | {"EVA_DATA_DIR": str(data), "EVA_LOG_LEVEL": "INFO", "EVA_WORKER_NICE": "5"}


@contextmanager
def browsing(playwright, chromium=CHROMIUM):
    """Debian's chromium without a screen, drawing 3D in software."""
    browser = playwright.chromium.launch(
        executable_path=chromium, args=["--no-sandbox", "--enable-unsafe-swiftshader"]
    )
    try:
        yield browser
    finally:
        browser.close()
