"""Time from `python -m runtime` of the tabletop deployment to its first idle snapshot, and the cost until then.

The bench is running already, and every file has been read before. Processor time and memory of each process are
measured at the snapshot; the loaded modules are listed at the end of the process.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import psutil

from benchmarks.report import Figure, Report
from runtime.clients.client import StationClient
from runtime.core.errors import RuntimeFault
from runtime.ipc.bus import Endpoints
from tests.crash.lab import ROOT, Lab

PROGRAMS = {
    "supervisor": "runtime.__main__",
    "control": "runtime.processes.control.process",
    "coordinator": "runtime.processes.coordinator.process",
    "reception": "runtime.processes.reception.process",
    "media": "runtime.processes.media.process",
    "guard": "runtime.processes.guard.process",
}
_LOADED = Path(__file__).parent / "loaded"
_STARTS = 5
_PATIENCE_S = 120.0
_POLL_S = 0.02


@dataclass(frozen=True, slots=True)
class StartedStation:
    """Idle station, with a client, its processes, and the time that it took to become idle [s]."""

    client: StationClient
    processes: Mapping[str, psutil.Process]
    seconds: float


@contextmanager
def started(
    node: Mapping[str, str], folder: Path, *assignments: str, broken: str = ""
) -> Iterator[StartedStation]:
    """Yield the station of the tabletop deployment, connected to the node `node`.

    Afterwards `folder`/loaded has a list of modules for each program. `broken` is a comma-separated list of modules
    that its processes cannot import.
    """
    (folder / "loaded").mkdir(parents=True)
    settings = (
        f'transport.sub_endpoint="{node["obs_endpoint"]}"',
        f'transport.pub_endpoint="{node["action_endpoint"]}"',
        f'data_dir="{folder}"',
        "recording.min_free_bytes=0",
        *assignments,
    )
    path = os.pathsep.join(filter(None, (str(_LOADED), os.environ.get("PYTHONPATH"))))
    environment = os.environ | {
        "PYTHONPATH": path,
        "EVA_LOADED": str(folder / "loaded"),
        "EVA_BROKEN": broken,
    }
    sets = [part for setting in settings for part in ("--set", setting)]
    begun = time.monotonic()
    with (folder / "station.log").open("w") as log:
        family = subprocess.Popen(
            [sys.executable, "-m", "runtime", "deployments/tabletop.toml", *sets],
            stderr=log,
            cwd=ROOT,
            env=environment,
        )
    client = StationClient(_station_dir(folder, assignments), holder="benchmark")
    try:
        _await_idle(client, family, folder)
        seconds = time.monotonic() - begun
        pids = {**Endpoints(_station_dir(folder, assignments)).read("supervisor"), "supervisor": family.pid}
        yield StartedStation(client, {name: psutil.Process(int(pids[name])) for name in PROGRAMS}, seconds)
    finally:
        client.close()
        family.send_signal(signal.SIGTERM)
        family.wait(_PATIENCE_S)


def _station_dir(folder: Path, assignments: tuple[str, ...]) -> Path:
    """Return the folder of the deployment's station, or of the station that the assignments name."""
    named = [
        assignment.partition("=")[2].strip('"')
        for assignment in assignments
        if assignment.startswith("station=")
    ]
    return folder / "stations" / (named[-1] if named else "bench-1")


def _await_idle(client: StationClient, family: subprocess.Popen[bytes], folder: Path) -> None:
    until = time.monotonic() + _PATIENCE_S
    while time.monotonic() < until and family.poll() is None:
        try:
            if client.status(_POLL_S * 10)["state_is"]["idle"]:
                return
        except RuntimeFault:
            time.sleep(_POLL_S)
    raise SystemExit(f"the station did not become idle: {(folder / 'station.log').read_text()[-2000:]}")


def loaded(folder: Path, process: str) -> list[str]:
    """Return the modules that a process of a station in `folder` had loaded at its end."""
    return (folder / "loaded" / PROGRAMS[process]).read_text().split()


def _once(node: Mapping[str, str], folder: Path) -> dict[str, Any]:
    with started(node, folder) as station:
        row: dict[str, Any] = {"station_ready_s": station.seconds}
        for name, process in station.processes.items():
            used = process.cpu_times()
            row[f"cpu_s.{name}"] = used.user + used.system
            row[f"memory_mb.{name}"] = process.memory_full_info().pss / 1e6
    return row | {f"modules.{name}": len(loaded(folder, name)) for name in PROGRAMS}


def measure(seconds: float) -> Report:
    """Measure `station_ready_s`, and `cpu_s.PROCESS`, `modules.PROCESS` and `memory_mb.PROCESS`; medians of 5 starts.

    `seconds` is ignored.
    """
    with tempfile.TemporaryDirectory() as name:
        lab = Lab(Path(name))
        try:
            lab.node()
            node = lab.addresses["node"]
            rows = [_once(node, Path(name) / str(start)) for start in range(1 + _STARTS)][1:]
        finally:
            for child in lab.children.values():
                assert child.stdin is not None
                child.stdin.close()
                child.wait(_PATIENCE_S)
    middle = {key: median(row[key] for row in rows) for key in rows[0]}
    units = {"station_ready_s": "s", "cpu_s": "s", "modules": "", "memory_mb": "MB"}
    figures = [
        Figure(key, value, units[key.partition(".")[0]], "<= 2" if key == "station_ready_s" else "")
        for key, value in sorted(middle.items(), key=lambda item: (item[0] != "station_ready_s", item[0]))
    ]
    return Report("start", figures, rows)
