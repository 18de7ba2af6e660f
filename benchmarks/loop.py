"""The control loop under its real load: node, three cameras at 30 Hz, policy, recording, at 30 and 100 Hz.

Beside it runs, in a process of its own, the loop that most client libraries use (sleep what is left of the
period), so that both see the same machine at the same time.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.report import Figure, Report
from runtime.recording.reader import open_episode
from runtime.sim.demo import StandIns, run_station, start_standins

RATES = (30.0, 100.0)


def measure(seconds: float) -> Report:
    """`lateness_p99_ms.HZ`, `missed_ticks.HZ`, `rate_error_ppm.HZ` and the same of the common loop."""
    figures: list[Figure] = []
    rows = []
    for rate in RATES:
        row = _case(rate, seconds)
        rows.append(row)
        name = f"{rate:g}"
        fifo = str(row["scheduling"]).startswith("FIFO")
        figures += [
            Figure(f"lateness_p99_ms.{name}", row["lateness_p99_ms"], "ms", "<= 0.5" if fifo else "<= 2"),
            Figure(f"lateness_max_ms.{name}", row["lateness_max_ms"], "ms"),
            Figure(f"missed_ticks.{name}", row["missed"], "", "== 0"),
            Figure(f"rate_error_ppm.{name}", abs(row["rate_error_ppm"]), "ppm", "<= 50"),
            Figure(f"sleep_loop_rate_error_ppm.{name}", abs(row["sleep_rate_error_ppm"]), "ppm"),
            Figure(f"rows_repeated.{name}", row["repeated"], ""),
        ]
    return Report("loop", figures, rows)


def _case(rate: float, seconds: float) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        sleeper = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.sleeper", str(rate), str(seconds)],
            stdout=subprocess.PIPE,
            text=True,
        )
        result = _station(rate, seconds, Path(folder))
        woke = np.array(json.loads(sleeper.communicate()[0]))
        episode = open_episode(Path(result["episode_path"]))
        ticks = episode.ticks
        steps, sent = np.array(ticks["step"].to_pylist()), np.array(ticks["sent"].to_pylist())
        assert episode.outcome is not None
        return {
            "rate": rate,
            "ticks": len(steps),
            "lateness_p99_ms": result["control"]["lateness_p99_ms"],
            "lateness_max_ms": result["control"]["lateness_max_ms"],
            "missed": result["control"]["missed"],
            "scheduling": result["control"]["scheduling"],
            "rate_error_ppm": _rate_error(steps, sent, rate),
            "sleep_rate_error_ppm": _rate_error(np.arange(len(woke)), woke, rate),
            "rows": episode.frames,
            "repeated": max(episode.outcome["repeated"].values()),
        }


def _station(rate: float, seconds: float, folder: Path) -> dict[str, dict[str, float]]:
    standins = StandIns()
    try:
        assignments = [
            *start_standins(standins, "agilex_piper"),
            f"control.rate={rate}",
            "recording.fps=30.0",
            f"run.duration_s={seconds}",
            f'data_dir="{folder}"',
            "recording.min_free_bytes=0",
        ]
        code, result = run_station("--headless", assignments)
        if code:
            raise SystemExit(f"the station failed: {result.get('error', 'no result')}")
        return result
    finally:
        standins.end()


def _rate_error(steps: np.ndarray, times: np.ndarray, rate: float) -> float:
    """Parts per million by which the fitted rate differs from `rate`."""
    period = np.polyfit(steps, times, 1)[0]
    return float((1.0 / period / rate - 1.0) * 1e6)
