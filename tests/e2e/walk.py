"""A lab of a server, three robots' computers and an operator's desk, built by the commands of the documents alone."""

import copy
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

from tests import migrated
from tests.e2e.bench_page import BenchPage
from tests.e2e.lab import CHROMIUM, ROOT, WIDE, environment, unhandled
from tests.namespaces import Network
from tests.processes import PATIENCE_MS, PATIENCE_S, eventually

ROBOTS = ("bench-a", "bench-b", "bench-c")
NAMES = ("alder-secret", "birch-secret")  # of the checkpoints, which nobody at a bench may see
PLAN = "three-benches"
_DOCUMENT = (ROOT / "docs" / "administrator.md").read_text("utf-8")
_BLOCKS = "".join(re.findall(r"^```\n(.*?)^```", _DOCUMENT, re.DOTALL | re.MULTILINE))
_FIRST = re.compile(r"Open (?P<url>\S+)/first-account/ and type this code: +(?P<code>\S+)")
_SMALL = "--width 64 --height 48"  # pictures: less processor time
SETUP = f"""
[[scene]]
name = "block"
title = "Block"
instruction = "put the block on the plate"
criterion = "It lies there."
time_limit_s = 120.0
{
    "".join(
        f'''
[[scene.position]]
number = {number}
label = "position {number}"
bench = {{ block = [-0.14, 0.26, 0], plate = [0.08, 0.34] }}
'''
        for number in range(1, 1 + len(ROBOTS))
    )
}
[[scene.milestone]]
order = 1
text = "It is held"
[[scene.milestone]]
order = 2
text = "It lies there"
required = true

[[checkpoint]]
name = "{NAMES[0]}"
policy = {{ url = "ws://127.0.0.1:9001" }}
[[checkpoint]]
name = "{NAMES[1]}"
policy = {{ url = "ws://127.0.0.1:9002" }}

[[plan]]
name = "{PLAN}"
title = "Three benches"
question = "Is {NAMES[0]} better?"
positions = [{", ".join(f'{{ scene = "block", number = {number} }}' for number in range(1, 1 + len(ROBOTS)))}]
checkpoints = ["{NAMES[0]}", "{NAMES[1]}"]
repetitions = 1
"""


def documented(begins, **places):
    """The one command of the administrator's document that begins so; `places` are put in it."""
    found = [line for line in _BLOCKS.splitlines() if line.startswith(begins)]
    assert len(set(found)) == 1, f"{len(found)} commands of the document begin with {begins!r}"
    for place, given in places.items():
        assert place in found[0], f"{found[0]!r} has no {place}"
        found[0] = found[0].replace(place, given)
    return found[0]


def as_run(command):
    """Its environment and its words: `make lab` is what the Makefile makes of it, less what it installs."""
    words = shlex.split(command, comments=True)
    given = {}
    while "=" in words[0]:
        name, _, value = words.pop(0).partition("=")
        given[name] = value
    if words[:2] == ["make", "lab"]:
        more = [word for argument in words[2:] for word in shlex.split(argument.partition("=")[2])]
        return given, [sys.executable, "manage.py", "lab", *more]
    assert words[0] in (".venv/bin/python", "python"), command
    return given, [sys.executable, *words[1:]]


class Desk(BenchPage):
    """A window of somebody's at the desk; `seen`: addresses that it asked, what its live sockets got, its pages."""

    def __init__(self, browser, walk, username):
        self.seen = []
        super().__init__(browser, walk, username, WIDE)
        self._watch()

    def another(self):
        """One more window of the same person, with the same lists of what was seen and complained of."""
        made = copy.copy(self)
        made.page = self.context.new_page()
        made.page.set_default_timeout(PATIENCE_MS)
        made._listen()
        made._watch()
        return made

    def _watch(self):
        self.page.on("websocket", lambda socket: socket.on("framereceived", self._frame))
        self.page.on("response", lambda response: self.seen.append(response.url))

    def look(self):
        """Keep what the page says now."""
        self.seen.append(self.page.content())

    def api(self, path):
        """From within the page: the test itself has no way into that network."""
        return self.page.evaluate("path => fetch(`/api/v1/${path}`).then(answer => answer.json())", path)

    def _frame(self, frame):
        self.seen.append(frame if isinstance(frame, str) else frame.decode("utf-8", "replace"))

    @property
    def complaints(self):
        """Those of its scripts: not the browser's own of a network without HTTPS, nor of what was refused and said."""
        own = ("Cross-Origin-Opener-Policy", "409 (Conflict)")
        return [said for said in self.errors if not any(words in said for words in own)]


class Walk:
    """The lab and its robots; people log in at `url`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.network = Network(("lab", *ROBOTS, "desk"), closed=ROBOTS)
        self.address = self.network.address["lab"]
        self.passwords = {"alma": "leaf-of-the-alder-7", "ann": "root-of-the-birch-8"}
        self.children: dict[str, subprocess.Popen[bytes]] = {}
        chromium = folder / "chromium"
        chromium.write_text(f'#!/bin/sh\nexec {" ".join(self.network.inside["desk"])} {CHROMIUM} "$@"\n')
        chromium.chmod(0o755)
        self.chromium = str(chromium)
        for computer in ("lab", *ROBOTS):
            self.data(computer).mkdir(mode=0o700)
        migrated.copy(self.data("lab"))

    def data(self, computer):
        """The data folder of a computer."""
        return self.folder / computer

    def lab(self):
        """Start the lab for stations on other computers in a trusted network; the code of the first account."""
        gate, words = as_run(documented("EVA_GATE=", **{"lab.example.org": self.address}))
        trusted, more = as_run(documented_inline("EVA_ALLOWED_HOSTS=10.0.0.7", "10.0.0.7", self.address))
        host = more[more.index("--host") :][:2]
        self.start("lab", [*words, *host], **gate, **trusted)
        said = eventually(
            lambda: _FIRST.search(self.log("lab")), f"the lab's code; {self.log('lab')}", 3 * PATIENCE_S
        )
        assert said is not None
        self.url = said["url"]
        return said["code"]

    def run(self, computer, command, said=None):
        """What a command of the document says that ends by itself."""
        given, words = as_run(command)
        done = subprocess.run(
            [*self.network.inside[computer], *words],
            cwd=ROOT,
            env=environment(self.data(computer)) | given,
            input=said,
            capture_output=True,
            text=True,
            timeout=3 * PATIENCE_S,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    def start(self, computer, words, name="", **given):
        """Start what goes on until the end."""
        name = name or computer
        with (self.folder / f"{name}.log").open("w") as log:
            self.children[name] = subprocess.Popen(
                [*self.network.inside[computer], *words],
                cwd=ROOT,
                env=environment(self.data(computer)) | given | {"PYTHONUNBUFFERED": "1"},
                stdin=subprocess.PIPE,  # the lifeline of those that are asked to have one
                stdout=log,
                stderr=log,
            )

    def station(self, name):
        """Start a simulated station and its link on its computer, which is enrolled."""
        deployment = self.folder / f"{name}.toml"
        deployment.write_text(f'extends = "{ROOT}/deployments/tabletop.toml"\nstation = "{name}"\n')
        station = documented(
            ".venv/bin/python -m runtime.standins.lockstep",
            **{"deployments/MINE.toml": f"{deployment} {_SMALL}"},
        )
        link = documented(".venv/bin/python -m runtime.link", NAME=name)
        for process, command in ((name, station), (f"{name}.link", link)):
            self.start(name, [*as_run(command)[1], "--lifeline"], process)

    def scan(self, *words):
        """What `scan.py` finds from the desk."""
        found = [*self.network.inside["desk"], sys.executable, "-m", "tests.e2e.scan", *words]
        done = subprocess.run(
            found, cwd=ROOT, check=True, capture_output=True, text=True, timeout=3 * PATIENCE_S
        )
        return json.loads(done.stdout)

    def log(self, name):
        """What a process has said."""
        return (self.folder / f"{name}.log").read_text("utf-8", "replace")

    def close(self):
        """End all of it."""
        try:
            for child in reversed(self.children.values()):
                child.terminate()
            ended = {name: child.wait(PATIENCE_S) for name, child in self.children.items()}
            for child in self.children.values():
                assert child.stdin is not None
                child.stdin.close()
        finally:
            self.network.close()
        assert set(ended.values()) <= {0}, ended
        assert unhandled(self.data("lab")) == []


def documented_inline(begins, place, given):
    """A command within a sentence of the document."""
    found = re.search(rf"`({re.escape(begins)}[^`]*)`", _DOCUMENT)
    assert found, f"the document has no command {begins!r}"
    return found[1].replace(place, given)
