"""A lab's gate and a robot's computer as real processes: on loopback, or each in a network namespace of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from django.conf import settings
from django.db import connection

from tests.evaweb.stand_in import FakeStation
from tests.namespaces import Network
from tests.processes import PATIENCE_S
from tests.sources import ROOT


class Loopback:
    """Both on one computer, as processes alone."""

    host = "127.0.0.1"
    lab: tuple[str, ...] = ()
    robot: tuple[str, ...] = ()

    def close(self) -> None:
        """Nothing was made."""


class Namespaces:
    """Two computers with a cable between them; the robot's lets nothing in. CalledProcessError without rights."""

    def __init__(self) -> None:
        self._network = Network(("lab", "robot"), closed=("robot",))
        self.host = self._network.address["lab"]
        self.lab, self.robot = self._network.inside["lab"], self._network.inside["robot"]

    def pull(self) -> None:
        """Pull the cable out of the robot's computer."""
        self._network.pull("robot")

    def plug(self) -> None:
        """Plug it in again."""
        self._network.plug("robot")

    def close(self) -> None:
        """Both are gone."""
        self._network.close()


class Elsewhere:
    """A station without a robot on its own computer, and the lab of this test's database."""

    def __init__(self, folder: Path, net: Loopback | Namespaces, name: str) -> None:
        self.net, self.name, self.data = net, name, folder / "robot"
        self.station = FakeStation(self.data, name)
        self.port = self.second_port = 0
        self._logs = folder
        self._children: dict[str, subprocess.Popen[str]] = {}
        self._environment = {**os.environ, "EVA_LOG_LEVEL": "INFO", "PYTHONUNBUFFERED": "1"}

    def gate(self) -> None:
        """Start the lab's gate on free ports; where it was before, once it was killed."""
        database = connection.settings_dict["NAME"]
        lab = {
            "DJANGO_SETTINGS_MODULE": "evaweb.settings",
            "EVA_DATA_DIR": str(settings.DATA_DIR),
            "DATABASE_URL": f"sqlite:///{database}",
            "EVA_RESERVE_GB": "0",
        }
        ports = ("--port", str(self.port), "--second-port", str(self.second_port))
        words = ("manage.py", "gate", "--host", self.net.host, *ports)
        child = self._start("gate", self.net.lab, words, lab)
        assert child.stdout is not None
        line = child.stdout.readline()
        assert line, f"the gate did not start: {self.log('gate')[-2000:]}"
        told = json.loads(line)
        self.port, self.second_port = int(told["port"]), int(told["second_port"])

    def keys(self, *words: str) -> str:
        """`python -m runtime.keys` on the robot's computer; what it says."""
        done = subprocess.run(
            [*self.net.robot, sys.executable, "-m", "runtime.keys", "--data-dir", str(self.data), *words],
            cwd=ROOT,
            env=self._environment,
            capture_output=True,
            text=True,
            timeout=3 * PATIENCE_S,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    def link(self, **more: str) -> None:
        """Start the link on the robot's computer, with `more` in its environment."""
        words = ("-m", "runtime.link", self.name, "--data-dir", str(self.data))
        self._start("link", self.net.robot, words, more)

    def kill(self, name: str) -> None:
        """End a process as a power cut does."""
        child = self._children.pop(name)
        child.kill()
        child.wait(PATIENCE_S)
        for pipe in (child.stdin, child.stdout):
            assert pipe is not None
            pipe.close()

    def log(self, name: str) -> str:
        """What a process has said."""
        return (self._logs / f"{name}.log").read_text("utf-8", "replace")

    def _start(
        self, name: str, inside: tuple[str, ...], words: tuple[str, ...], more: dict[str, str]
    ) -> subprocess.Popen[str]:
        with (self._logs / f"{name}.log").open("w") as said:
            self._children[name] = subprocess.Popen(
                [*inside, sys.executable, *words, "--lifeline"],
                cwd=ROOT,
                env={**self._environment, **more},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=said,
                text=True,
            )
        return self._children[name]

    def close(self) -> None:
        """End all of it; a process that does not end by itself fails the test."""
        for child in self._children.values():
            assert child.stdin is not None
            child.stdin.close()
        for child in self._children.values():
            child.wait(PATIENCE_S)
            assert child.stdout is not None
            child.stdout.close()
        self.station.end()
        self.net.close()
