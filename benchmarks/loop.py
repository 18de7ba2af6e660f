"""Control loop under its real load, at 30, 100 and 200 Hz: lateness and missed ticks.

Per rate a complete lab runs: a bench that renders and sends three 640x480 cameras at 30 Hz, recording, previews,
continuous inference, web, worker, and five pages that show everything. Two comparison loops run in parallel, each in a
process of its own: one that only sleeps to absolute deadlines, in control's scheduling class, and the loop of most
client libraries, which sleeps for the rest of the period. So all three run on the same machine at the same time.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.labs import (
    ROOT,
    STATION,
    ProcessorUsage,
    RunningLab,
    Scheduling,
    busy_lab,
    only_episode,
    set_up,
    watch,
)
from benchmarks.report import Figure, Report
from evaweb.lab.rest_client import LivePage
from runtime.recording.reader import Episode

SECONDS = 30.0
RATES = (30.0, 100.0, 200.0)
VIEWERS = 5
_PRIORITY = 20
_SATURATED = 95.0 * (
    os.cpu_count() or 1
)  # [% of one processor] load above which only a real-time class is on time
_MARGIN_S = 3.0  # pages are open before and after the run
_QUANTILES = {"p50": 50.0, "p99": 99.0, "p999": 99.9, "max": 100.0}

Times = NDArray[np.float64]
Steps = NDArray[np.int64]


def measure(seconds: float, assignments: Sequence[str] = ()) -> Report:
    """Measure `lateness_*_ms.HZ`, `missed_ticks.HZ`, `rate_error_ppm.HZ` and `ratio_to_bare_loop.HZ` for each rate."""
    rows = [case(rate, seconds, assignments) for rate in RATES]
    return Report("loop", [figure for row in rows for figure in _figures(row)], rows)


def _figures(row: Mapping[str, Any]) -> list[Figure]:
    name, fifo = f"{row['rate']:g}", str(row["scheduling"]).startswith("FIFO")
    late = row["lateness_ms"]
    busy = sum(row["cpu_percent"][usage] for usage in ("lab", "measuring", "others"))
    allowed = {"p99": "<= 0.5", "p999": "<= 3"} if fifo else {"p99": "<= 2" if busy < _SATURATED else ""}
    return [
        *(Figure(f"lateness_{q}_ms.{name}", late[q], "ms", allowed.get(q, "")) for q in _QUANTILES),
        Figure(f"missed_ticks.{name}", row["missed"], "", "== 0" if fifo else ""),
        Figure(f"effective_rate_hz.{name}", row["effective_rate_hz"], "Hz"),
        Figure(f"rate_error_ppm.{name}", abs(row["rate_error_ppm"]), "ppm", "<= 100" if fifo else ""),
        Figure(f"ratio_to_bare_loop.{name}", row["ratio"], "", "" if fifo else "<= 1.5"),
        Figure(f"bare_loop_p99_ms.{name}", row["bare"]["lateness_ms"]["p99"], "ms"),
        Figure(f"sleep_loop_rate_error_ppm.{name}", abs(row["sleep_rate_error_ppm"]), "ppm"),
        Figure(f"sent_p99_ms.{name}", row["sent_ms"]["p99"], "ms"),
        Figure(f"pictures_repeated.{name}", row["repeated"], ""),
        Figure(f"lab_cpu_percent.{name}", row["cpu_percent"]["lab"], "%"),
        Figure(f"machine_cpu_percent.{name}", busy, "%"),
    ]


def case(rate: float, seconds: float, assignments: Sequence[str], without: str = "") -> dict[str, Any]:
    """Run one lab at a rate; `without` names measures that control omits, see benchmarks.measures."""
    settings = [f"control.rate={rate}", "recording.fps=30.0", f"run.duration_s={seconds}", *assignments]
    with tempfile.TemporaryDirectory() as folder:
        with busy_lab(Path(folder), settings, without) as lab:
            priority = [] if "control.realtime=off" in assignments else [str(_PRIORITY)]
            sleepers = [["deadlines", str(rate), str(seconds), *priority], ["rest", str(rate), str(seconds)]]
            state, references, used = _run(lab, sleepers, seconds)
            episode = only_episode(lab.data)
        return {"rate": rate, **used, **_judged(episode, rate, state["control"], references)}


def _run(
    lab: RunningLab, sleepers: Sequence[Sequence[str]], seconds: float
) -> tuple[Mapping[str, Any], list[Any], dict[str, Any]]:
    """Perform one run while pages view it.

    Args:
        lab: Lab with the station.
        sleepers: Arguments of each loop of `benchmarks.sleeper` that runs at the same time, for comparison.
        seconds: Duration of the run [s].

    Returns:
        Final state, results of the comparison loops, and processor usage.
    """
    with closing(LivePage(lab.visitor, STATION)) as shared:
        set_up(shared)
        watching = watch(lab.visitor, seconds + 2 * _MARGIN_S, reading=VIEWERS)
        loops = [_sleeper(arguments, lab.environment) for arguments in sleepers]
        shared.command("run")
        shared.wait(lambda state: state["state_is"]["going"], 10.0, "starting the run")
        processors, scheduler = (
            ProcessorUsage(lab.process),
            Scheduling(lab.process, "runtime.processes.control.process"),
        )
        state = shared.wait(lambda state: not state["state_is"]["going"], seconds + 30.0, "the run")
        percent, scheduled = processors.percent(), scheduler.figures()
        watching.communicate()
    if not state["state_is"]["ready"]:
        raise SystemExit(f"the run ended {state['state']}: {state['reason']}")
    references = [json.loads(loop.communicate()[0]) for loop in loops]
    return state, references, {"cpu_percent": percent, "scheduled": scheduled}


def _sleeper(arguments: Sequence[str], environment: Mapping[str, str]) -> subprocess.Popen[str]:
    """Start a process that runs one of the loops with which the control loop is compared."""
    command = [sys.executable, "-m", "benchmarks.sleeper", *arguments]
    return subprocess.Popen(command, cwd=ROOT, env=dict(environment), stdout=subprocess.PIPE, text=True)


def _judged(
    episode: Episode, rate: float, control: Mapping[str, Any], references: Sequence[Any]
) -> dict[str, Any]:
    table, (bare, common) = episode.ticks, references
    steps, planned, woke, sent = (
        table.column(name).to_numpy() for name in ("step", "planned", "woke", "sent")
    )
    skipped = np.diff(steps, prepend=steps[0] - 1) - 1
    late = woke - planned + skipped / rate  # a tick after a gap was due when the gap began
    own, floor = _spread(late), _spread(np.array(bare["late"]))
    assert episode.outcome is not None
    outcome: Mapping[str, Any] = episode.outcome
    return {
        "ticks": len(steps),
        "scheduling": control["scheduling"],
        "lateness_ms": own,
        "sent_ms": _spread(sent - planned),
        "missed": int(skipped.sum()),
        **_rate(steps, sent, rate),
        "ratio": own["p99"] / floor["p99"],
        "bare": {"scheduling": bare["scheduling"], "lateness_ms": floor},
        "sleep_rate_error_ppm": _rate(np.array(common["steps"]), np.array(common["woke"]), rate)[
            "rate_error_ppm"
        ],
        "rows": episode.frames,
        "repeated": max(outcome["repeated"].values()),
        "muxed_ms": outcome["muxed_ms"],
        "load": os.getloadavg(),
    }


def _spread(seconds: Times) -> dict[str, float]:
    return {name: float(np.percentile(seconds, q)) * 1000.0 for name, q in _QUANTILES.items()}


def _rate(steps: Steps, times: Times, rate: float) -> dict[str, float]:
    """Return the rate fitted to `times` of `steps`, and its deviation from `rate` [ppm]."""
    rate_hz = 1.0 / float(np.polyfit(steps, times, 1)[0])
    return {"effective_rate_hz": rate_hz, "rate_error_ppm": (rate_hz / rate - 1.0) * 1e6}
