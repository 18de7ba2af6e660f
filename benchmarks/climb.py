"""Number of stations that a lab supports, and of pages on one station: doubled until an answer is too late.

Lab, stations with simulated robots, and pages are all on this machine, so that the bottleneck at the failing step need
not be the lab.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import psutil

from benchmarks.estop_presses import OpenPage
from benchmarks.labs import RunningLab, machine_used, named, watch
from benchmarks.report import Figure

RUNGS = (1, 2, 4, 8, 16, 32)  # numbers of stations
MOST_STATIONS = RUNGS[-1]
_MOST_VIEWERS = 640
_ESTOP_MS, _VIEWER_MS = 200.0, 250.0
_FULL = 90.0  # [% of a core]
_PAUSE_S = 0.05  # between two presses
_STATION_BYTES = 500e6  # memory per additional station, with its robot


@dataclass(frozen=True, slots=True)
class _Rung:
    """Step of the climb, measured with `count` stations or with `count` viewers.

    It has the delays of e-stop presses and of viewers' pages, and the load of the processors.
    """

    count: int
    estop_p99_ms: float
    viewer_p99_ms: float
    machine_percent: float
    fullest: str  # process with the highest load of a core
    fullest_percent: float

    @property
    def holds(self) -> bool:
        """True if both delays are within their limits."""
        return self.estop_p99_ms <= _ESTOP_MS and self.viewer_p99_ms <= _VIEWER_MS

    @property
    def saturated(self) -> str:
        """Text that states which answers were too late, and which resource was saturated."""
        late = "presses" if self.estop_p99_ms > _ESTOP_MS else "pages"
        if self.machine_percent >= _FULL * (psutil.cpu_count() or 1):
            return (
                f"{late}, with all processors full (most of it {self.fullest}, {self.fullest_percent:.0f} %)"
            )
        if self.fullest_percent >= _FULL:
            return f"{late}, with one processor full of {self.fullest}"
        return f"{late}, with no processor full"

    def row(self, what: str) -> dict[str, Any]:
        """Return the step as a row of the report; `what` is "stations" or "viewers"."""
        return {
            what: self.count,
            **{name: getattr(self, name) for name in self.__slots__ if name != "count"},
        }


def stations(
    running: RunningLab, add: Callable[[str], None], names: list[str], seconds: float
) -> tuple[list[Figure], list[Mapping[str, Any]]]:
    """Measure `stations_max`: the largest number of stations at which answers are in time.

    E-stop presses alternate between the stations, each of which has one open page. The station named first in `names`
    is running already; `add` starts a further one by its name.
    """
    rungs: list[Any] = []
    up = 1
    for count in RUNGS:
        if psutil.virtual_memory().available < (count - up) * _STATION_BYTES:
            return _told("stations", rungs, "the machine's memory")
        while up < count:
            add(names[up])
            up += 1
        rungs.append(_rung(running, names[:count], 1, count, seconds))
        if not rungs[-1].holds:
            break
    return _told("stations", rungs, f"nothing up to {MOST_STATIONS}")


def viewers(running: RunningLab, name: str, seconds: float) -> tuple[list[Figure], list[Mapping[str, Any]]]:
    """Measure `viewers_max`: the largest number of pages on one station at which answers are in time.

    The station's e-stop is pressed at every step.
    """
    rungs, count = [], 10
    while count <= _MOST_VIEWERS:
        rungs.append(_rung(running, [name], count, count, seconds))
        if not rungs[-1].holds:
            break
        count *= 2
    return _told("viewers", rungs, f"nothing up to {_MOST_VIEWERS}")


def _told(label: str, rungs: list[_Rung], otherwise: str) -> tuple[list[Figure], list[Mapping[str, Any]]]:
    most = max((rung.count for rung in rungs if rung.holds), default=0)
    failed = [rung for rung in rungs if not rung.holds]
    rows = [rung.row(label) for rung in rungs]
    saturated = failed[0].saturated if failed else otherwise
    return [Figure(f"{label}_max", float(most), "")], [*rows, {f"{label}_saturated_first": saturated}]


def _rung(running: RunningLab, names: list[str], pages: int, count: int, seconds: float) -> _Rung:
    """Open `pages` pages on each of the stations `names` for `seconds`, and return the measured step.

    Meanwhile the e-stops of the stations are pressed in turn. `count`, the number of stations or pages that this step
    measures, is stored in the result.
    """
    watching = [watch(running.visitor, seconds, station=name, reading=pages) for name in names]
    open_pages = [OpenPage(running.visitor, running.announced["stops"], name) for name in names]
    times_ms: list[float] = []
    before, begun = _used(), time.monotonic()
    while time.monotonic() - begun < seconds:
        page = open_pages[len(times_ms) % len(open_pages)]
        times_ms.append(page.press(f"press {len(times_ms)}").ms)
        time.sleep(_PAUSE_S)
    passed, after = time.monotonic() - begun, _used()
    percent = {name: 100.0 * (used - before.get(name, 0.0)) / passed for name, used in after.items()}
    machine = percent.pop("")
    ages = [age for child in watching for age in json.loads(child.communicate()[0])["ages_ms"]]
    for page in open_pages:
        page.close()
    fullest = max(percent, key=lambda name: percent[name])
    return _Rung(
        count,
        float(np.percentile(times_ms, 99)),
        float(np.percentile(ages, 99)) if ages else float("inf"),
        machine,
        fullest.rpartition(" ")[0],
        percent[fullest],
    )


def _used() -> dict[str, float]:
    """Return the processor time [s] of every process by name and id; under "" that of the whole machine."""
    usage: dict[str, float] = {}
    for process in psutil.process_iter():
        try:
            name, times = named(process.cmdline()), process.cpu_times()
        except psutil.Error:  # it has ended, or access is denied
            continue
        usage[f"{name} {process.pid}"] = times.user + times.system
    usage[""] = machine_used()
    return usage
