"""Twenty viewers of one running station: their delay, their effect on the control loop, and the cost of stalled
viewers.

The complete demo runs: bench, policies, worker, web. The first trial has no viewer, the second twenty; then ten viewers
that never read join an idle station.
"""

from __future__ import annotations

import json
import tempfile
import threading
import time
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks.labs import STATION, lab, watch
from benchmarks.report import Figure, Report
from evaweb.lab.rest_client import LivePage, RestClient
from evaweb.lab.single_trial import TrialChoice, start

_VIEWERS, _STALLED = 20, 10


def measure(seconds: float) -> Report:
    """Measure `viewer_p99_ms`, `stalled_viewer_mb`, `lateness_p99_ms`, and lateness without viewers."""
    with tempfile.TemporaryDirectory() as folder:
        ready = Path(folder) / "ready.json"
        with lab(["manage.py", "demo", "--port", "0", "--ready-file", str(ready)], ready) as demo:
            visitor, web = demo.visitor, demo.announced["pids"]["web"]
            alone = _run(visitor, seconds, 0)
            watched = _run(visitor, seconds, _VIEWERS)
            stalled = _stalled(visitor, web, seconds)
    ages = np.array(watched["ages_ms"])
    figures = [
        Figure("viewer_p50_ms", float(np.percentile(ages, 50)), "ms"),
        Figure("viewer_p99_ms", float(np.percentile(ages, 99)), "ms", "<= 25"),
        Figure("viewer_frames_per_s", float(np.mean(watched["frames"])) / seconds, "Hz"),
        Figure("stalled_viewer_mb", stalled, "MB", "<= 2"),
        Figure("lateness_p99_ms", watched["control"]["lateness_p99_ms"], "ms", "<= 2"),
        Figure("lateness_p99_ms.alone", alone["control"]["lateness_p99_ms"], "ms"),
        Figure("missed_ticks", watched["control"]["missed"] - alone["control"]["missed"], "", "== 0"),
    ]
    rows = [{"viewers": n, **measured["control"]} for n, measured in ((0, alone), (_VIEWERS, watched))]
    return Report("live", figures, rows)


def _run(visitor: RestClient, seconds: float, viewers: int) -> Mapping[str, Any]:
    """Run one trial for `seconds` with `viewers` viewers, and void it afterwards."""
    with closing(LivePage(visitor, STATION)) as page:
        trial = start(visitor, page, TrialChoice(STATION, "block-on-plate", 1, "pick-place-40k", seed=1))
        viewed = _viewers(visitor, seconds, reading=viewers) if viewers else _wait(seconds)
        state = page.wait(lambda state: True, 10, "looking")
        page.command("stop")
        page.wait(lambda state: state["state_is"]["ready"], 10, "stopping")
        visitor.post(f"stations/{STATION}/lease", {"action": "give_up", "page": page.page})
    _void(visitor, trial)
    return {**viewed, "control": state["control"]}


def _wait(seconds: float) -> dict[str, Any]:
    time.sleep(seconds)
    return {}


def _void(visitor: RestClient, trial: int) -> None:
    while visitor.get(f"trials/{trial}")["status"] not in ("ended", "interrupted"):
        time.sleep(0.1)
    visitor.post(f"trials/{trial}/void", {"reason": "a benchmark"})


def _viewers(visitor: RestClient, seconds: float, **counts: int) -> dict[str, Any]:
    child = watch(visitor, seconds, STATION, **counts)
    result: dict[str, Any] = json.loads(child.communicate()[0])
    return result


def _stalled(visitor: RestClient, web: int, seconds: float) -> float:
    """Return the largest growth of the web process [MB] per viewer that never reads."""
    process = psutil.Process(web)
    _viewers(visitor, 3.0, reading=1)  # the first viewer's one-time cost is not growth
    before = process.memory_info().rss
    largest = before
    watching = threading.Thread(target=_viewers, args=(visitor, seconds), kwargs={"stalled": _STALLED})
    watching.start()
    while watching.is_alive():
        largest = max(largest, process.memory_info().rss)
        time.sleep(0.2)
    watching.join()
    return float(largest - before) / _STALLED / 1e6
