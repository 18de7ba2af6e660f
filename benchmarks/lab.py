"""Lab with stations on other computers: e-stop, idle cost, lost link, transfer of an episode, and limits.

Lab and station are processes of this machine with separate data folders, linked over loopback, so that delays of a real
network are not included.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, TypeVar
from uuid import uuid4

import numpy as np
import psutil

from benchmarks.climb import stations, viewers
from benchmarks.estop_lab import PRESSED
from benchmarks.estop_presses import OpenPage, Press
from benchmarks.labs import RunningLab, lab
from benchmarks.linked_lab import STATIONS
from benchmarks.report import Figure, Report
from benchmarks.start import StartedStation, started
from evaweb.lab.rest_client import LivePage
from runtime.clients.client import StationClient
from runtime.core.errors import RuntimeFault
from tests.crash.lab import ROOT, Lab

SECONDS = 20.0
_PAUSE_S = 0.05  # between two presses
_CUTS = 10
_UPLOAD_MB = 400
_PATIENCE_S = 120.0
_LOOK_S = 0.005
_WANTED_IDLE = {"cpu_percent.station": "<= 8", "memory_mb.station": "<= 400"}
Found = TypeVar("Found")


class _Page(LivePage):
    """Open page that stores whether the link to the station works."""

    link_ok = False

    def _on_message(self, message: Mapping[str, Any]) -> None:
        if message.get("type") == "link":
            self.link_ok = bool(message["ok"])
        super()._on_message(message)


def measure(seconds: float) -> Report:
    """Measure a lab with a linked station; presses and idling last `seconds` each.

    The names of the figures:
    * `estop_p99_ms`: delay of a press from a page through the link; `estop_here_p99_ms`: the same at the station.
    * `lost_shown_s`: time until a lost link is shown.
    * `cpu_percent` and `memory_mb`: of an idle station with its link, and of the lab's gate.
    * `upload_mb_s`: speed of a transfer; processor time of both ends and delay of presses are measured meanwhile.
    * `stations_max` and `viewers_max`: measured by `benchmarks.climb`, with half of `seconds` per step.
    """
    os.environ["EVA_UPLOAD_MB_S"] = "50"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        gate = {"EVA_GATE": f"127.0.0.1:{two_free_ports()}", "EVA_GATE_NAME": "127.0.0.1"}
        with ExitStack() as up:
            running = up.enter_context(
                lab(["-m", "benchmarks.linked_lab", str(folder / "ready.json")], folder / "ready.json", gate)
            )

            def add(name: str) -> StartedStation:
                return up.enter_context(_linked(running, folder / name, name))

            station = add(PRESSED)
            link = _until(lambda: _link_of(station.processes["supervisor"]), "the link's process")
            figures, rows = _measured(running, {**station.processes, "link": link}, folder / PRESSED, seconds)

            def one_more(name: str) -> None:
                add(name)
                _shown(running, name)

            for more, rungs in (
                viewers(running, PRESSED, seconds / 2),
                stations(running, one_more, list(STATIONS), seconds / 2),
            ):
                figures += more
                rows += rungs
    return Report("lab", figures, rows)


@contextmanager
def _linked(running: RunningLab, folder: Path, name: str) -> Iterator[StartedStation]:
    """Yield a station with a simulated robot, in a data folder of its own, that is enrolled at the lab."""
    folder.mkdir()
    bench = Lab(folder)
    try:
        with started(bench.node().addresses["node"], folder, f'station="{name}"') as station:
            enrol(folder, running.announced["enrol"][name])
            yield station
    finally:
        for child in bench.children.values():
            assert child.stdin is not None
            child.stdin.close()
            child.wait(_PATIENCE_S)


def _shown(running: RunningLab, name: str) -> None:
    """Wait until a page shows the station as connected."""
    page = _Page(running.visitor, name)
    _until(lambda: page.link_ok, f"the link of {name}")
    page.close()


def _measured(
    running: RunningLab, station: Mapping[str, psutil.Process], robot: Path, seconds: float
) -> tuple[list[Figure], list[Mapping[str, Any]]]:
    link = station["link"]
    _shown(running, PRESSED)
    idle = _idle({**station, "gate": psutil.Process(running.announced["pids"]["gate"])}, seconds)
    for unit in ("cpu_percent", "memory_mb"):
        idle[f"{unit}.station"] = sum(idle[f"{unit}.{name}"] for name in station)
    through = _presses(running, seconds)
    local_ms = _presses_here(robot, seconds / 4)
    processes = {"link": link, "gate": psutil.Process(running.announced["pids"]["gate"])}
    sending, upload = _upload(running, robot, processes)
    lost = _cuts(running, link)
    times_ms = np.array([press.ms for press in through])
    figures = [
        Figure("estop_p50_ms", float(np.percentile(times_ms, 50)), "ms"),
        Figure("estop_p99_ms", float(np.percentile(times_ms, 99)), "ms", "<= 100"),
        Figure("estop_not_done", float(sum(press.status != "done" for press in through)), "", "== 0"),
        Figure("estop_here_p99_ms", float(np.percentile(local_ms, 99)), "ms"),
        Figure("estop_uploading_p99_ms", sending, "ms", "<= 100"),
        *(Figure(name, value, "s" if name.startswith("cpu") else "MB/s") for name, value in upload.items()),
        Figure("lost_shown_s", max(lost), "s", "<= 1.5"),
        *(
            Figure(name, value, "%" if name.startswith("cpu") else "MB", _WANTED_IDLE.get(name, ""))
            for name, value in idle.items()
        ),
    ]
    wrong = [{"status": press.status, "reason": press.reason} for press in through if press.status != "done"]
    return figures, [{"presses": len(through), "lost_shown_s": lost, "not_done": wrong[:10]}]


def _idle(processes: Mapping[str, psutil.Process], seconds: float) -> dict[str, float]:
    """Return the load of idle processes [% of a core] and their proportional memory [MB]."""
    before = {name: sum(process.cpu_times()[:2]) for name, process in processes.items()}
    time.sleep(seconds)
    usage: dict[str, float] = {}
    for name, process in processes.items():
        used = sum(process.cpu_times()[:2]) - before[name]
        usage[f"cpu_percent.{name}"] = 100.0 * used / seconds
        usage[f"memory_mb.{name}"] = process.memory_full_info().pss / 1e6
    return usage


def _presses(running: RunningLab, seconds: float) -> list[Press]:
    """Press from an open page, repeatedly for `seconds`; return the presses.

    Each press is sent in both ways at once: over the page's websocket, and to the process for stops.
    """
    pressed: list[Press] = []
    page = OpenPage(running.visitor, running.announced["stops"])
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        pressed.append(page.press(f"press {len(pressed)}"))
        time.sleep(_PAUSE_S)
    page.close()
    return pressed


def _presses_here(robot: Path, seconds: float) -> list[float]:
    """Press the e-stop at the station's own socket, again and again for `seconds`.

    Return the time from each press to its answer [ms].
    """
    times_ms: list[float] = []
    client = StationClient(robot / "stations" / PRESSED, "benchmark")
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        begun = time.monotonic()
        client.estop(f"press {len(times_ms)}")
        times_ms.append((time.monotonic() - begun) * 1000.0)
        time.sleep(_PAUSE_S)
    client.close()
    return times_ms


def _upload(
    running: RunningLab, robot: Path, processes: Mapping[str, psutil.Process]
) -> tuple[float, dict[str, float]]:
    """Return the 99th percentile of presses during a transfer [ms], and figures of the transfer.

    These are its speed, and the processor time per GB at either end.
    """
    folder = robot / "episodes" / str(uuid4())
    folder.mkdir(parents=True)
    (folder / "manifest.json").write_text(json.dumps({"uuid": folder.name, "station": PRESSED}))
    with (folder / "front.mp4").open("wb") as file:
        for _ in range(_UPLOAD_MB):
            file.write(os.urandom(1_000_000))
    before = {name: sum(process.cpu_times()[:2]) for name, process in processes.items()}
    (folder / "outcome.json").write_text("{}")
    arriving = running.data / "episodes" / ".arriving" / PRESSED / folder.name / "front.mp4"
    _until(arriving.exists, "the first byte of the episode")
    begun = time.monotonic()
    pressed = _presses(running, _UPLOAD_MB / 50 * 0.7)
    _until((running.data / "episodes" / folder.name).exists, "the episode")
    seconds = time.monotonic() - begun
    usage = {"upload_mb_s": _UPLOAD_MB / seconds}
    for name, process in processes.items():
        used = sum(process.cpu_times()[:2]) - before[name]
        usage[f"cpu_s_per_gb.{name}"] = used / (_UPLOAD_MB / 1000)
    return float(np.percentile([press.ms for press in pressed], 99)), usage


def _cuts(running: RunningLab, link: psutil.Process) -> list[float]:
    """Return for each pause of the link (SIGSTOP) the time until an open page shows that the link is lost [s]."""
    page, delays = _Page(running.visitor, PRESSED), []
    try:
        for _ in range(_CUTS):
            _until(lambda: page.link_ok, "the link")
            begun = time.monotonic()
            link.send_signal(signal.SIGSTOP)
            try:
                _until(lambda: not page.link_ok, "the loss")
                delays.append(time.monotonic() - begun)
            finally:
                link.send_signal(signal.SIGCONT)
    finally:
        page.close()
    return delays


def enrol(robot: Path, words: Sequence[str]) -> None:
    """Enrol the station's computer at the lab with these `words`; the station's supervisor then starts its link."""
    for command in (["new"], ["enrol", *words]):
        keys = [sys.executable, "-m", "runtime.keys", "--data-dir", str(robot), *command]
        subprocess.run(keys, cwd=ROOT, env=os.environ, check=True, stdout=subprocess.DEVNULL)


def _link_of(supervisor: psutil.Process) -> psutil.Process | None:
    children = supervisor.children()
    return next((child for child in children if "runtime.link" in child.cmdline()), None)


def _until(search: Callable[[], Found], label: str) -> Found:
    until, reason = time.monotonic() + _PATIENCE_S, "nothing was found"
    while time.monotonic() < until:
        try:
            if thing := search():
                return thing
        except (RuntimeFault, psutil.Error) as fault:
            reason = str(fault)
        time.sleep(_LOOK_S)
    raise SystemExit(f"{label}: not within {_PATIENCE_S:g} s: {reason}")


def two_free_ports() -> int:
    """Return a free port whose next port is free, too; another program may still use them before the lab does."""
    while True:
        with socket.socket() as first:
            first.bind(("127.0.0.1", 0))
            port: int = first.getsockname()[1]
            with socket.socket() as second:
                try:
                    second.bind(("127.0.0.1", port + 1))
                except OSError:
                    continue
            return port
