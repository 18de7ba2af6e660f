"""Recordings of a complete station in parallel to busy loops: age of joints in shared state, and losses."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.busy_lab import PATIENT
from benchmarks.recording_station import SIZE, PatientLab
from runtime.clients.client import Refused
from runtime.recording.reader import Episode, open_episode
from tests.processes import PATIENCE_S

_LOOK_S = 20.0  # less than the window of the ages
_LOOP = "while True: pass"
_NODE_PRIORITY = 30  # above ours
# Tolerant limits except for the age of joints, which is measured.
_JUDGED = ("safety.joint_age_s", "safety.refusals_to_hold")
_SETTINGS = [one for one in PATIENT if not one.startswith(_JUDGED)]
CASES = {"quiet": (False, "auto"), "busy": (True, "auto"), "busy_ordinary": (True, "off")}


def record(folder: Path, seconds: float) -> dict[str, Any]:
    """Record for `seconds` on a quiet machine, with a busy loop per core, and with busy loops without real-time
    class.
    """
    rows = []
    for name, (busy, realtime) in CASES.items():
        lab = PatientLab(folder / name)
        lab.folder.mkdir(parents=True)
        try:
            lab.node(*SIZE).server()
            lab.up(
                *_SETTINGS,
                f"run.duration_s={seconds + 600}",
                "bus.preview_rate=15",
                f'control.realtime="{realtime}"',
            )
            _put_first(lab.children["node"].pid)
            lab.ready()
            rows.append({"case": name, **_run(lab, seconds, busy)})
        finally:
            lab.close()
    return {"rows": rows}


def _run(lab: PatientLab, seconds: float, busy: bool) -> dict[str, Any]:
    lab.client.command("run")
    uuid = lab.client.wait(lambda status: status["recording"]["uuid"], 2 * PATIENCE_S)["recording"]["uuid"]
    with _loops(os.cpu_count() or 1 if busy else 0):
        ages, reasons = _watch(lab, seconds)
        status = lab.client.status()
    lab.client.command("stop")
    lab.reach("ready", "idle")
    lab.client.wait(lambda status: status["episode"].get("uuid") == uuid, 2 * PATIENCE_S)
    episode = open_episode(lab.data / "episodes" / uuid)
    return {
        "seconds": seconds,
        "scheduling": status["link"]["scheduling"],
        "age_ms": {quantile: max(age[quantile] for age in ages) for quantile in ages[0]},
        "holds": reasons,
        **pictures(episode),
    }


def _watch(lab: PatientLab, seconds: float) -> tuple[list[dict[str, float]], list[str]]:
    """Return the ages of joints at intervals, and the reasons for holds; a run that holds is resumed."""
    end, look_at = time.monotonic() + seconds, time.monotonic() + _LOOK_S
    ages: list[dict[str, float]] = []
    reasons: list[str] = []
    while (now := time.monotonic()) < end or not ages:
        lab.client.renew()
        status = lab.client.status(30.0)
        if not status["state_is"]["going"]:
            reasons.append(status["reason"])
        if status["state_is"]["held"]:
            with suppress(Refused):  # not possible yet: retried at the next poll
                lab.client.command("resume")
        if now >= min(look_at, end):
            look_at = now + _LOOK_S
            ages.append(status["link"]["age_ms"])
        time.sleep(0.5)
    return ages, reasons


def pictures(episode: Episode) -> dict[str, int]:
    """Return the number of rows, and of images that were given to the recorder but are not in the videos.

    The keys are `rows`, `lost` (missing images that the recording flags as lost) and `silent` (missing images that it
    does not flag).
    """
    flagged = silent = 0
    rows = episode.rows
    for camera in episode.layout.cameras:
        captured = rows.column(f"capture_time.{camera}").to_numpy()
        repeated, lost = (rows.column(f"{mark}.{camera}").to_numpy() for mark in ("repeated", "lost"))
        new = np.concatenate([[True], captured[1:] != captured[:-1]])
        flagged += int(lost.sum())
        silent += int((repeated & new & ~lost).sum())
    return {"rows": len(rows), "lost": flagged, "silent": silent}


def _put_first(process: int) -> None:
    """Give the node real-time priority if permitted, because it represents another machine, which ours cannot delay."""
    with suppress(PermissionError):
        for thread in Path(f"/proc/{process}/task").iterdir():
            os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, os.sched_param(_NODE_PRIORITY))


@contextmanager
def _loops(count: int) -> Iterator[None]:
    """Run `count` busy processes within the context."""
    loops = [subprocess.Popen([sys.executable, "-c", _LOOP]) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()
