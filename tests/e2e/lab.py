"""A whole demo lab of real processes on a free port, and a real browser that looks at it."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[2]
CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"
NO_CHROMIUM = "Debian's chromium is not installed (apt-get install chromium)"
STATION = "bench-1"
WIDE, TABLET = {"width": 1440, "height": 900}, {"width": 1024, "height": 768}


def alive(pid):
    """Whether the process runs; one that only waits to be reaped does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def eventually(check, seconds, what):
    """Wait for something that real processes do in their own time."""
    deadline = time.monotonic() + seconds
    while not (found := check()):
        assert time.monotonic() < deadline, f"{what}: not within {seconds} s"
        time.sleep(0.05)
    return found


class Demo:
    """`manage.py demo` in a data folder of its own."""

    def __init__(self, folder, *options):
        self.folder = folder
        self.data = folder / "data"
        self._options = options
        self.child = None

    def start(self):
        """Start it and wait until it is up; returns itself."""
        ready = self.folder / "ready.json"
        ready.unlink(missing_ok=True)
        self.output = (self.folder / "demo.log").open("a")
        self.child = subprocess.Popen(
            [sys.executable, "manage.py", "demo", "--port", "0", "--ready-file", str(ready), *self._options],
            cwd=ROOT,
            env=environment(self.data),
            stdout=self.output,
            stderr=self.output,
        )

        def up():
            assert self.child.poll() is None, (self.folder / "demo.log").read_text()[-2000:]
            return ready.exists()

        eventually(up, 90, "the demo is up")
        found = json.loads(ready.read_text())
        self.url, self.passwords, self.pids = found["url"], found["passwords"], found["pids"]
        return self

    def end(self, number=signal.SIGINT):
        """End it as a person would; returns the exit code."""
        if self.child.poll() is None:
            self.child.send_signal(number)
        code = self.child.wait(60)
        self.output.close()
        return code


def environment(data):
    """What a lab of the tests is started with: nothing of the settings that the tests themselves run on."""
    ours = {key: value for key, value in os.environ.items() if not key.startswith(("EVA_", "DJANGO_"))}
    return ours | {"EVA_DATA_DIR": str(data), "EVA_LOG_LEVEL": "INFO"}


@contextmanager
def browsing(playwright):
    """Debian's chromium without a screen, drawing 3D in software."""
    browser = playwright.chromium.launch(
        executable_path=CHROMIUM, args=["--no-sandbox", "--enable-unsafe-swiftshader"]
    )
    try:
        yield browser
    finally:
        browser.close()
