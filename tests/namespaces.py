"""Computers with a switch between them, each a network namespace of this one; some of them let nothing in."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from uuid import uuid4

from tests.processes import PATIENCE_S

_DOCUMENT = Path(__file__).parents[1] / "docs" / "administrator.md"
_SUBNET = "10.77.0"


class Network:
    """Computers by name, the first of which has the switch; those in `closed` have the firewall of a robot's computer
    as the administrator's document gives it. CalledProcessError without rights.
    """

    def __init__(self, names: Sequence[str], closed: Sequence[str] = ()) -> None:
        end = uuid4().hex[:6]
        self._spaces = {name: f"eva-{name}-{end}" for name in names}
        self.inside = {name: ("ip", "netns", "exec", space) for name, space in self._spaces.items()}
        self.address = {name: f"{_SUBNET}.{number}" for number, name in enumerate(names, start=1)}
        self._switch = names[0]
        try:
            for space in self._spaces.values():
                _run("ip", "netns", "add", space)
                _run("ip", "-n", space, "link", "set", "lo", "up")
            self._ip(self._switch, "link", "add", "eth0", "type", "bridge")
            self._up(self._switch)
            for number, name in enumerate(names[1:], start=1):
                peer = ("type", "veth", "peer", "name", "eth0", "netns", self._spaces[name])
                self._ip(self._switch, "link", "add", f"port{number}", *peer)
                self._ip(self._switch, "link", "set", f"port{number}", "master", "eth0", "up")
                self._up(name)
            for name in closed:
                _run(*self.inside[name], "nft", "-f", "-", said=_firewall())
        except BaseException:
            self.close()
            raise

    def pull(self, name: str) -> None:
        """Pull the cable out of a computer."""
        self._ip(name, "link", "set", "eth0", "down")

    def plug(self, name: str) -> None:
        """Plug it in again."""
        self._ip(name, "link", "set", "eth0", "up")

    def open(self, name: str) -> None:
        """Take a computer's firewall down."""
        _run(*self.inside[name], "nft", "flush", "ruleset")

    def close(self) -> None:
        """All of them are gone."""
        for space in self._spaces.values():
            with suppress(subprocess.CalledProcessError):
                _run("ip", "netns", "delete", space)

    def _up(self, name: str) -> None:
        self._ip(name, "address", "add", f"{self.address[name]}/24", "dev", "eth0")
        self._ip(name, "link", "set", "eth0", "up")

    def _ip(self, name: str, *words: str) -> None:
        _run("ip", "-n", self._spaces[name], *words)


def why_no_namespaces() -> str:
    """Why this machine makes none; "" where it does."""
    absent = [program for program in ("ip", "nft") if shutil.which(program) is None]
    if absent:
        return f"{' and '.join(absent)} not installed"
    try:
        Network(("lab", "robot"), closed=("robot",)).close()
    except (OSError, subprocess.CalledProcessError) as error:
        return f"network namespaces cannot be made here: {getattr(error, 'stderr', error)!s:.200}"
    return ""


def _firewall() -> str:
    found = re.search(r"```\n(table inet robot \{.*?)```", _DOCUMENT.read_text("utf-8"), re.DOTALL)
    assert found, f"{_DOCUMENT} has no firewall for a robot's computer"
    return found[1]


def _run(*words: str, said: str | None = None) -> None:
    subprocess.run(words, input=said, check=True, capture_output=True, text=True, timeout=PATIENCE_S)
