"""Check of this machine: what a lab needs, what was found, and what to do."""

from __future__ import annotations

import getpass
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from django.conf import settings
from django.db import Error

from evaweb.core.errors import EvaError, StationGone
from evaweb.lab import lifetime
from evaweb.lab.deployments import lab_runs
from evaweb.serving.stop_port import read_stop_port
from evaweb.stations.models import Station
from evaweb.stations.runtime_client import connection_to

_PATIENCE_S = 10.0
_STATION_S = 1.0
_GB = 1e9
_PIECE, _PIECES, _WRITE_S = (
    1 << 20,
    32,
    1.0,
)  # speed test of the disk: block size [bytes], most blocks, most time [s]
_PORTS = (8000, 8001)  # of web and stops, if the lab is started without options
_PRIORITY = 20  # default of control.realtime_priority
_TRY = """
import json
from runtime.core.realtime import advice, enter_realtime
got = enter_realtime({0})
print(json.dumps([got, advice(got, {0})]))
"""


class State(StrEnum):
    """Verdict of one check."""

    GOOD = "good"
    LACKING = "lacking"  # works, but worse than it could
    BAD = "bad"  # does not work
    UNKNOWN = "not known"

    @property
    def tone(self) -> str:
        """Tone of the verdict's chip, by its name in the style sheets."""
        return {"good": "ok", "lacking": "warn", "bad": "danger"}.get(self.value, "neutral")


@dataclass(frozen=True, slots=True)
class Line:
    """Result of one check: state, finding, meaning, and advice, "" if nothing has to be done."""

    name: str
    state: State
    found: str
    means: str
    advice: str = ""


def lines() -> list[Line]:
    """Return all checks in order of importance; takes a few seconds at most."""
    checks = (realtime, cores, memory, shared_memory, disk_room, disk_speed, clock, gpu, sockets, ports)
    return [*(check() for check in checks), *stations()]


def realtime() -> Line:
    """Check whether a station started by this account gets SCHED_FIFO and locked memory, by trying in a process."""
    means = "Control ticks on time however busy the machine is, where it has the class SCHED_FIFO and locked memory."
    output = _output([sys.executable, "-c", _TRY.format(_PRIORITY)])
    try:
        got, advice = json.loads(output or "")
    except ValueError:
        return Line("Real-time rights", State.UNKNOWN, "could not be tried", means)
    locked = "unlocked" not in got
    if locked and not advice:
        return Line("Real-time rights", State.GOOD, got, means)
    lock = (
        "" if locked else "memory is not locked: give the account memlock unlimited (LimitMEMLOCK=infinity)"
    )
    return Line("Real-time rights", State.LACKING, got, means, "; ".join(filter(None, (advice, lock))))


def cores() -> Line:
    """Check the processor cores that this account may use."""
    count, load = len(os.sched_getaffinity(0)), os.getloadavg()[0]
    means = "A station runs five processes, two of them in real time; web, worker and policy servers share the rest."
    text = f"{count} cores, load {load:.1f}"
    if count < 2:
        return Line("Cores", State.BAD, text, means, "use a machine with four or more cores")
    if count < 4:
        advice = (
            "it is enough for one station; small camera pictures and no policy server beside it spare work"
        )
        return Line("Cores", State.LACKING, text, means, advice)
    return Line("Cores", State.GOOD, text, means)


def memory() -> Line:
    """Check the available main memory."""
    facts = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text("ascii").splitlines())
    total, free = (int(facts[key].split()[0]) * 1024 for key in ("MemTotal", "MemAvailable"))
    text = f"{free / _GB:.1f} of {total / _GB:.1f} GB available"
    means = "Web, worker, each station and each policy server of this machine share it."
    if free < 0.5 * _GB:
        return Line("Memory", State.BAD, text, means, "end other programs, or use a machine with more memory")
    if free < 2 * _GB:
        return Line(
            "Memory", State.LACKING, text, means, "watch it: what runs beside the lab should be small"
        )
    return Line("Memory", State.GOOD, text, means)


def shared_memory() -> Line:
    """Check the space in /dev/shm, which a station's processes use for images."""
    means = "The processes of a station share their pictures and state there."
    return _room(
        "Shared memory", Path("/dev/shm"), 0.064, 0.5, means, "give it more (--shm-size in a container)"
    )


def disk_room() -> Line:
    """Check the space on the disk of the data folder."""
    means = "Recordings and datasets go there; a run is refused where there is too little room to record it."
    folder = Path(settings.DATA_DIR)
    return _room(
        "Disk, free", folder, 2, 50, means, f"make room, or put {folder} on a larger disk (EVA_DATA_DIR)"
    )


def disk_speed() -> Line:
    """Measure the speed of flushed writes to the disk of the data folder, for about a second."""
    means = "Recordings are flushed as they are written; a disk that is slower than the cameras loses rows."
    path = Path(settings.DATA_DIR) / ".disk_speed"
    piece, written, worst, begun = os.urandom(_PIECE), 0, 0.0, time.monotonic()
    try:
        with path.open("wb") as file:
            for _ in range(_PIECES):
                before = time.monotonic()
                file.write(piece)
                file.flush()
                os.fsync(file.fileno())
                written += 1
                worst = max(worst, time.monotonic() - before)
                if time.monotonic() - begun > _WRITE_S:
                    break
    except OSError as error:
        return Line(
            "Disk, speed", State.BAD, f"{path.parent}: {error.strerror}", means, "check the disk first"
        )
    finally:
        path.unlink(missing_ok=True)
    rate = written * _PIECE / 1e6 / (time.monotonic() - begun)
    text = f"{rate:.0f} MB/s with every megabyte flushed, the longest flush {1000 * worst:.0f} ms"
    if rate < 20:
        return Line(
            "Disk, speed", State.LACKING, text, means, "a local SSD is faster; a network folder is a risk"
        )
    return Line("Disk, speed", State.GOOD, text, means)


def clock() -> Line:
    """Check whether a time server synchronises the machine's clock, according to chrony or systemd."""
    means = "Times of recordings, of other computers' robots and of logs agree only where clocks are kept by a server."
    advice = (
        "install chrony (apt-get install chrony), and give it a time server that the robot's computer has too"
    )
    tracking = _output(["chronyc", "-n", "tracking"])
    if tracking and "Leap status" in tracking:
        facts = dict(map(str.strip, line.split(":", 1)) for line in tracking.splitlines() if ":" in line)
        good = facts["Leap status"] == "Normal"
        text = f"chrony: {facts['Leap status'].lower()}, {facts.get('System time', 'offset not told')}"
        return Line("Clock", State.GOOD if good else State.LACKING, text, means, "" if good else advice)
    word = (_output(["timedatectl", "show", "--property", "NTPSynchronized", "--value"]) or "").strip()
    if word in ("yes", "no"):
        text = "systemd: synchronised" if word == "yes" else "systemd: not synchronised"
        return Line(
            "Clock",
            State.GOOD if word == "yes" else State.LACKING,
            text,
            means,
            "" if word == "yes" else advice,
        )
    text = "neither chrony nor systemd answers here"
    return Line("Clock", State.UNKNOWN, text, means, "in a container the host's clock counts: look there")


def gpu() -> Line:
    """Check for GPUs for policy servers, according to nvidia-smi."""
    means = "Policy servers want one; a lab whose servers are elsewhere, or scripted, needs none."
    command = ["nvidia-smi", "--query-gpu=name,memory.used,memory.total", "--format=csv,noheader"]
    rows = (_output(command) or "").strip()
    if not rows:
        return Line("GPU of policy servers", State.UNKNOWN, "none seen", means)
    return Line("GPU of policy servers", State.GOOD, "; ".join(rows.splitlines()), means)


def sockets() -> Line:
    """Check the folder of the account's sockets, which may be removed at its last logout."""
    means = "Web and stations meet in Unix sockets there."
    folder = os.environ.get("XDG_RUNTIME_DIR")
    if not folder:
        return Line("Sockets", State.GOOD, "a folder of this account's own, not one of systemd's", means)
    if not os.access(folder, os.W_OK):
        advice = "log in anew, or start the lab without XDG_RUNTIME_DIR"
        return Line("Sockets", State.BAD, f"{folder} cannot be written", means, advice)
    lingers = Path("/var/lib/systemd/linger", getpass.getuser()).exists() or os.geteuid() == 0
    if lingers:
        return Line("Sockets", State.GOOD, folder, means)
    advice = f"`loginctl enable-linger {getpass.getuser()}` where no login of the account stays open"
    return Line(
        "Sockets", State.LACKING, f"{folder}, which ends with the account's last login", means, advice
    )


def ports() -> Line:
    """Check the ports of web and stops: those of the running lab, else the default ones."""
    means = "Browsers reach the web at one, and its process for stops at the other."
    stored = read_stop_port()
    if lab_runs() and stored:
        return Line("Ports", State.GOOD, f"web {stored.web_port}, stops {stored.port}: this lab's", means)
    occupied = []
    for port in _PORTS:
        try:
            lifetime.require_free("127.0.0.1", port)
        except EvaError:
            occupied.append(port)
    if occupied:
        text = f"{' and '.join(map(str, occupied))} taken by another program"
        return Line("Ports", State.LACKING, text, means, "start the lab with --port, and --stop-port")
    return Line("Ports", State.GOOD, f"{' and '.join(map(str, _PORTS))} are free", means)


def stations() -> list[Line]:
    """Return the real-time scheduling that each running station reports."""
    means = "Control sends, and reception sees: each is on time where it runs in SCHED_FIFO."
    station_lines = []
    try:
        names = list(Station.objects.filter(active=True).values_list("name", flat=True))
    except Error:  # a lab has no tables before its first start
        return []
    for name in names:
        try:
            snapshot = connection_to(name).status(timeout=_STATION_S)
        except StationGone:
            continue
        control, reception = (
            str((snapshot.get(part) or {}).get("scheduling", "")) for part in ("control", "link")
        )
        good = control.startswith("FIFO") and "unlocked" not in control
        text = f"control {control or 'not told'}, reception {reception or 'not told'}"
        advice = "" if good else "give the station's account the rights above, then start it anew"
        station_lines.append(
            Line(f"Station {name}", State.GOOD if good else State.LACKING, text, means, advice)
        )
    return station_lines


def _room(name: str, folder: Path, least_gb: float, good_gb: float, means: str, advice: str) -> Line:
    try:
        usage = shutil.disk_usage(folder)
    except OSError as error:
        return Line(name, State.UNKNOWN, f"{folder}: {error.strerror}", means)
    free = usage.free / _GB
    text = f"{free:.1f} of {usage.total / _GB:.1f} GB in {folder}"
    if free < least_gb:
        return Line(name, State.BAD, text, means, advice)
    if free < good_gb:
        return Line(name, State.LACKING, text, means, advice)
    return Line(name, State.GOOD, text, means)


def _output(arguments: Sequence[str]) -> str | None:
    """Return the output of a program; None if it is missing, fails, or takes too long."""
    try:
        completed = subprocess.run(
            arguments, capture_output=True, text=True, timeout=_PATIENCE_S, cwd=settings.BASE_DIR, check=True
        )
    except (OSError, subprocess.SubprocessError, UnicodeDecodeError):
        return None
    return completed.stdout
