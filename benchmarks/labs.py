"""Complete labs in separate processes, which benchmarks start, use from outside, and end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from evaweb.lab.rest_client import LivePage, RestClient
from runtime.recording.reader import Episode, open_episode

ROOT = Path(__file__).parents[1]
STATION = "bench-1"
STREAMS = ("state", "joints", "poses", "camera/cam_high", "camera/cam_left_wrist", "camera/cam_right_wrist")
_END_S = 60.0


@dataclass(frozen=True, slots=True)
class RunningLab:
    """Running lab, with a logged-in client and the addresses that the lab announced."""

    visitor: RestClient
    announced: Mapping[str, Any]
    process: psutil.Process
    data: Path
    environment: Mapping[str, str]  # of its processes


@contextmanager
def lab(
    program: Sequence[str], ready_file: Path, extra: Mapping[str, str] | None = None
) -> Iterator[RunningLab]:
    """Start `python PROGRAM`, which announces its lab in `ready_file`; its data folder is next to that file.

    `extra` is added to its environment variables.
    """
    data = ready_file.parent / "data"
    environment = os.environ | {"EVA_DATA_DIR": str(data), "EVA_LOG_LEVEL": "WARNING"} | dict(extra or {})
    child = subprocess.Popen([sys.executable, *program], cwd=ROOT, env=environment, stdout=subprocess.DEVNULL)
    try:
        while not ready_file.exists():
            if child.poll() is not None:
                raise SystemExit(f"the lab ended with {child.returncode} before it was ready")
            time.sleep(0.1)
        announced = json.loads(ready_file.read_text())
        visitor = RestClient(announced["url"])
        visitor.login("operator", announced["passwords"]["operator"])
        yield RunningLab(visitor, announced, psutil.Process(child.pid), data, environment)
    finally:
        child.send_signal(signal.SIGINT)
        child.wait(_END_S)


@contextmanager
def busy_lab(
    folder: Path, assignments: Sequence[str], without: str = "", *, numbered: bool = False
) -> Iterator[RunningLab]:
    """Yield the lab of `benchmarks.busy_lab`, with `assignments` to keys of its deployment.

    `without` is a comma-separated list of measures of runtime.core.realtime that its control process omits. With
    `numbered` its cameras show test patterns that contain the number of each picture, and there is no table.
    """
    sets = [part for assignment in assignments for part in ("--set", assignment)]
    sets += ["--numbered"] if numbered else []
    ready = folder / "ready.json"
    path = f"{ROOT / 'benchmarks' / 'without'}{os.pathsep}{ROOT}"
    patched = {"PYTHONPATH": path, "EVA_WITHOUT": without} if without else {}
    with lab(["-m", "benchmarks.busy_lab", str(ready), *sets], ready, patched) as running:
        yield running


def watch(
    visitor: RestClient, seconds: float, station: str = STATION, **counts: int
) -> subprocess.Popen[str]:
    """Open pages at the station in a separate process for `seconds`.

    `counts` has the number of pages by kind: `reading` pages draw what they receive, `stalled` pages never read.
    """
    options = [part for name, count in counts.items() for part in (f"--{name}", str(count))]
    command = [sys.executable, "-m", "benchmarks.viewers", visitor.url, station, visitor.cookies]
    command += ["--streams", ",".join(STREAMS), "--seconds", str(seconds), *options]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)


class ProcessorUsage:
    """Processor usage of a lab's processes, and of all other processes of the machine, since creation."""

    def __init__(self, lab: psutil.Process) -> None:
        self._lab = lab
        self._begun = time.monotonic()
        self._before = self._times()

    def percent(self) -> dict[str, float]:
        """Return the usage by process [% of one processor].

        Key `lab` is the sum of the lab's processes, `measuring` the benchmark's own (pages and comparison loops),
        `others` everything else on the machine.
        """
        seconds = time.monotonic() - self._begun
        now, before = self._times(), self._before
        percents = {name: (used - before.get(name, 0.0)) / seconds * 100.0 for name, used in now.items()}
        busy, measuring = percents.pop("busy"), percents.pop("ours")
        lab = sum(percents.values())
        return {**percents, "lab": lab, "measuring": measuring - lab, "others": busy - measuring}

    def _times(self) -> dict[str, float]:
        """Return the processor time of the lab's processes by name, of all our processes, and of the machine [s]."""
        lab = _used([self._lab, *self._lab.children(recursive=True)])
        me = psutil.Process()
        return {
            **lab,
            "ours": sum(_used([me, *me.children(recursive=True)]).values()),
            "busy": machine_used(),
        }


def _used(processes: Iterable[psutil.Process]) -> dict[str, float]:
    """Return user and system time by program [s]."""
    usage: dict[str, float] = {}
    for process in processes:
        try:
            name, times = named(process.cmdline()), process.cpu_times()
        except psutil.NoSuchProcess:  # it has ended since it was listed
            continue
        usage[name] = usage.get(name, 0.0) + times.user + times.system
    return usage


class Scheduling:
    """Statistics of how the kernel has scheduled one process of a lab since this object was created.

    `module` is the module that the process runs.
    """

    def __init__(self, lab: psutil.Process, module: str) -> None:
        (self._process,) = (p for p in lab.children(recursive=True) if named(p.cmdline()) == module)
        self._begun = time.monotonic()
        self._before = self._counts()

    def figures(self) -> dict[str, float]:
        """Return per second: time running and waiting for a processor [ms], involuntary switches, and page faults."""
        seconds = time.monotonic() - self._begun
        now = self._counts()
        return {name: (value - self._before[name]) / seconds for name, value in now.items()}

    def _counts(self) -> dict[str, float]:
        folder = Path("/proc") / str(self._process.pid)
        ran, waited = (int(part) / 1e6 for part in (folder / "schedstat").read_text().split()[:2])
        fields = (folder / "stat").read_text().rpartition(") ")[2].split()  # proc(5): from field 3 on
        return {
            "ran_ms": ran,
            "waited_ms": waited,
            "preempted": float(self._process.num_ctx_switches().involuntary),
            "minor_faults": float(fields[7]),
            "major_faults": float(fields[9]),
        }


def machine_used() -> float:
    times = psutil.cpu_times()
    return float(sum(times) - times.idle - times.iowait - times.guest - times.guest_nice)


def named(command: Sequence[str]) -> str:
    """Return the module or the management command that a process runs."""
    if "-m" in command:
        return command[command.index("-m") + 1]
    return next((part for part in command[1:] if not part.startswith("-") and "/" not in part), "?")


def set_up(page: LivePage) -> Mapping[str, Any]:
    """Claim the station and set it up; return its state when it is ready."""
    page.wait(lambda state: state["state_is"]["connected"], 60.0, "waiting for the station")
    page.claim()
    page.wait(lambda state: state["lease"]["epoch"] == page.epoch, 10.0, "waiting for the lease")
    page.command("setup")
    ready = page.wait(lambda state: not state["state_is"]["preparing"], 60.0, "setting up")
    if not ready["state_is"]["ready"]:
        raise SystemExit(f"set-up ended {ready['state']}: {ready['reason']}")
    return ready


def only_episode(data: Path, seconds: float = 30.0) -> Episode:
    """Return the only episode of a data folder as soon as it is closed."""
    deadline = time.monotonic() + seconds
    while not (outcomes := list(data.glob("episodes/*/outcome.json"))):
        if time.monotonic() > deadline:
            raise SystemExit(f"no episode was closed in {data} within {seconds:g} s")
        time.sleep(0.1)
    return open_episode(outcomes[0].parent)
