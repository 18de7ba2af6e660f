"""A station without a robot, and its panel as a real process over loopback."""

from __future__ import annotations

import http.client
import json
import os
import signal
import ssl
import subprocess
import sys
from pathlib import Path
from typing import Any

from runtime.clients.panel.pin import PinFile
from runtime.ipc.bus import Endpoints
from tests.evaweb.stand_in import FakeStation
from tests.processes import PATIENCE_S, eventually
from tests.sources import ROOT

PIN = "271828"
STATION = "bench-9"
PLAIN = {"host": "127.0.0.1", "port": 0, "names": [], "certificate": None, "key": None}


class Served:
    """A stand-in's panel; `ask` as a program does that knows the panel, unless other headers are given."""

    def __init__(self, data: Path, pin: str = PIN, **settings: Any) -> None:
        self.data, self.folder = data, data / "stations" / STATION
        self.station = FakeStation(data, STATION)
        said = {"panel": {**PLAIN, **settings}}
        (self.folder / "resolved.json").write_text(json.dumps(said), "utf-8")
        if pin:
            PinFile(self.folder).set(pin)
        self.start()

    def start(self) -> None:
        """Start the process, and wait until it listens."""
        words = ("-m", "runtime.clients.panel", STATION, "--data-dir", str(self.data), "--lifeline")
        self.child = subprocess.Popen(
            [sys.executable, *words], cwd=ROOT, env=dict(os.environ), stdin=subprocess.PIPE
        )
        self.url = eventually(self._listens, "the panel")
        self.port = int(self.url.rsplit(":", 1)[1])

    def _listens(self) -> str:
        assert self.child.poll() is None, "the panel has ended"
        endpoints = Endpoints(self.folder)
        if not endpoints.served("panel"):
            return ""
        found = endpoints.read("panel")
        return str(found["panel"]) if found["pid"] == self.child.pid else ""

    def kill(self) -> None:
        """End the process at once."""
        self.child.send_signal(signal.SIGKILL)
        self.child.wait()

    def connection(self, trusts: Path | None = None) -> http.client.HTTPConnection:
        """A connection, with TLS where a certificate is trusted."""
        if trusts is None:
            return http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        context = ssl.create_default_context(cafile=str(trusts))
        return http.client.HTTPSConnection("localhost", self.port, timeout=PATIENCE_S, context=context)

    def ask(
        self,
        method: str,
        path: str,
        said: Any = None,
        headers: dict[str, str] | None = None,
        trusts: Path | None = None,
    ) -> tuple[int, dict[str, str], bytes]:
        """Status, headers and content of the answer."""
        connection = self.connection(trusts)
        try:
            body = None if said is None else json.dumps(said)
            connection.request(method, path, body, {"X-EVA-Panel": "1"} if headers is None else headers)
            answer = connection.getresponse()
            return answer.status, dict(answer.getheaders()), answer.read()
        finally:
            connection.close()

    def entered(self, trusts: Path | None = None) -> dict[str, str]:
        """Headers of a browser that has given the PIN."""
        status, headers, content = self.ask("POST", "/pin", {"pin": PIN}, trusts=trusts)
        assert status == 200, content
        return {"X-EVA-Panel": "1", "Cookie": headers["Set-Cookie"].split(";")[0]}

    def end(self) -> None:
        """End the process as its supervisor does, and the station."""
        killed = self.child.returncode is not None
        assert self.child.stdin is not None
        self.child.stdin.close()
        code = self.child.wait(PATIENCE_S)
        self.station.end()
        assert killed or code == 0
