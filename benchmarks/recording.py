"""Cost of recording, and losses when processes are killed.

One station records three cameras of 640x480 at 30 Hz, ends the run and publishes the episode. Other stations record in
parallel to busy loops. Then our recorder alone and LeRobot's own writer receive the same frames at the same pace, if an
interpreter with LeRobot is available: this one, or those in EVA_LEROBOT_PYTHONS. Then processes are killed (kill -9) at
random moments, and the page that lists 10,000 episodes is requested.
"""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from benchmarks import recording_busy, recording_frames, recording_station
from benchmarks.busy_lab import PATIENT
from benchmarks.labs import ROOT
from benchmarks.recording_kills import KillCount, kill_recording, kill_worker, make_episodes
from benchmarks.report import Figure, Report

SECONDS = 60.0
_LONG_S = 600.0
_LONG_BUSY_S = 300.0
_KILLED_S = (
    200.0,
    60.0,
)  # for kills of recording processes and of the worker: the default run must end within ten minutes
_LEAST_KILLS = (8, 2)  # of these, however slow the machine is
_BESIDE_S = 15.0  # of the same frames, per writer
_LISTED = 10_000
_MODES = ("default", "streaming")


def measure(seconds: float, long: bool = False) -> Report:
    """Measure `frames_lost`, `intake_age_p99_ms`, `memory_growth_mb`, `cpu_core_percent`, `kill9_worst_loss_s` and
    others.

    The figure `load_1min` is the machine's load at the end of the benchmark; the load during each part is in the part's
    row.
    """
    seed = random.SystemRandom().randrange(1 << 32)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        station = _timed(recording_station.record, _made(folder / "station"), _LONG_S if long else seconds)
        busy = _timed(recording_busy.record, _made(folder / "busy"), _LONG_BUSY_S if long else seconds)
        frames = recording_frames.write(folder / "frames.npy")
        compared = _timed(_beside, folder, frames)
        kills = _timed(_kills, folder, frames, long, seed)
        listing = _timed(_listing, _made(folder / "listing"))
    return Report(
        "recording",
        figures(station, busy, compared, kills, listing),
        [
            {"part": "station", **station},
            {"part": "busy", **busy},
            {"part": "beside", **compared},
            {"part": "kills", "seed": seed, **kills},
            {"part": "listing", **listing},
        ],
    )


def figures(
    station: Mapping[str, Any],
    busy: Mapping[str, Any],
    beside: Mapping[str, Any],
    kills: Mapping[str, Any],
    listing: Mapping[str, Any],
) -> list[Figure]:
    """Return the figures of the five parts of the benchmark.

    Some figures have a requirement, others are only reported.
    """
    memory, disk = station["memory_mb"], station["to_disk_ms"]
    rows: Sequence[Mapping[str, Any]] = kills["rows"]
    return [
        Figure("frames_lost", station["frames_lost"], "", "== 0"),
        Figure("cpu_core_percent", station["cpu_core_percent"], "%", "<= 50"),
        Figure("cpu_core_percent.reception", station["cpu_core_percent_reception"], "%"),
        Figure("cpu_core_percent.not_recording", station["cpu_core_percent_not_recording"], "%"),
        *(
            Figure(f"intake_age_p99_ms.{row['case']}", row["age_ms"]["p99"], "ms", "<= 60")
            for row in busy["rows"]
        ),
        *(Figure(f"holds.{row['case']}", len(row["holds"]), "", "== 0") for row in busy["rows"]),
        *(Figure(f"pictures_lost.{row['case']}", row["lost"], "") for row in busy["rows"]),
        Figure("pictures_lost_silently", sum(row["silent"] for row in busy["rows"]), "", "== 0"),
        Figure("memory_growth_mb", memory["peak"] - memory["start"], "MB", "<= 50"),
        *(Figure(f"memory_{when}_mb", memory[when], "MB") for when in ("before", "start", "end", "peak")),
        *(Figure(f"capture_to_disk_{q}_ms", value, "ms") for q, value in disk.items()),
        Figure("stop_to_saved_s", station["stop_to_saved_s"], "s", "<= 1"),
        Figure("publish_s", station["publish_s"], "s"),
        Figure("publish_changed_frames", station["publish_changed_frames"], "", "== 0"),
        *_ratios(beside["rows"]),
        Figure("kill9_worst_loss_s", max(row["lost_s"] for row in rows), "s", "<= 1"),
        *(
            Figure(
                f"kill9_worst_loss_s.{process}",
                max(r["lost_s"] for r in rows if r["process"] == process),
                "s",
            )
            for process in dict.fromkeys(row["process"] for row in rows)
        ),
        Figure("kill9_kills", sum(row["after_s"] is not None for row in rows), ""),
        Figure("kill9_not_opening", sum(len(row.get("problems", ())) for row in rows), "", "== 0"),
        Figure("list_10000_ms", max(row["median_ms"] for row in listing["rows"]), "ms", "<= 200"),
        Figure("list_10000_processor_ms", max(row["processor_ms"] for row in listing["rows"]), "ms"),
        Figure("load_1min", os.getloadavg()[0], ""),
    ]


def _ratios(rows: Sequence[Mapping[str, Any]]) -> list[Figure]:
    """Return figures that compare the cost of LeRobot's writers with the cost of ours.

    They are the processor time per recorded frame in ms, and the processor time and the saving time as multiples of
    ours. The processor time of every writer includes writing the dataset.
    """
    (own,) = (row for row in rows if row["writer"] == "ours")
    per_frame = {row["writer"]: (row["capture_cpu_s"] + row["save_cpu_s"]) / row["frames"] for row in rows}
    ratios = [
        Figure(f"cpu_ms_per_frame.{writer}", value * 1000.0, "ms") for writer, value in per_frame.items()
    ]
    for row in rows:
        if row is not own:
            ratios += [
                Figure(f"cpu_ratio.{row['writer']}", per_frame[row["writer"]] / per_frame["ours"], "x"),
                Figure(f"save_ratio.{row['writer']}", row["save_s"] / own["save_s"], "x"),
            ]
    return ratios


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def _timed(part: Any, *arguments: Any) -> dict[str, Any]:
    """Execute `part`, one part of the benchmark, and return its results.

    The duration of the part and the machine's load at its end are added to the results.
    """
    begun = time.monotonic()
    print(f"recording: {part.__name__.strip('_')}", file=sys.stderr)  # progress, because it takes minutes
    measured = part(*arguments)
    return {**measured, "took_s": time.monotonic() - begun, "load": os.getloadavg()}


def _beside(folder: Path, frames: Path) -> dict[str, Any]:
    count = str(round(_BESIDE_S * 30))
    own = _child(sys.executable, "recording_alone", str(frames), count, str(folder / "ours"))
    rows = [{"writer": "ours", **own}]
    for number, python in enumerate(interpreters()):
        for mode in _MODES:
            where = str(folder / f"lerobot_{number}_{mode}")
            measured = _child(python, "recording_lerobot", str(frames), count, where, mode)
            rows.append({"writer": f"lerobot_{measured['version']}_{mode}", **measured})
    return {"rows": rows}


def interpreters() -> list[str]:
    """Return the Python interpreters with a LeRobot that can encode while recording (0.4.4 or later)."""
    named = [path for path in os.environ.get("EVA_LEROBOT_PYTHONS", "").split(":") if path]
    if find_spec("lerobot") is not None:
        named.append(sys.executable)
    program = "from importlib.metadata import version; print(version('lerobot'))"
    versions = {
        path: subprocess.run(
            [path, "-c", program], stdout=subprocess.PIPE, text=True, check=True
        ).stdout.strip()
        for path in named
    }
    return [
        path for path, release in versions.items() if tuple(map(int, release.split(".")[:3])) >= (0, 4, 4)
    ]


def _child(python: str, module: str, *arguments: str, **environment: str) -> dict[str, Any]:
    """Run a benchmark module and return the last line of its output as JSON.

    If it fails, exit with its complete error output.
    """
    command = [python, "-m", f"benchmarks.{module}", *arguments]
    completed = subprocess.run(
        command, cwd=ROOT, env=os.environ | environment, capture_output=True, text=True, check=False
    )
    if completed.returncode != 0:
        raise SystemExit(f"{' '.join(command)} ended with {completed.returncode}: {completed.stderr[-3000:]}")
    result: dict[str, Any] = json.loads(completed.stdout.splitlines()[-1])
    return result


def _kills(folder: Path, frames: Path, long: bool, seed: int) -> dict[str, Any]:
    """Kill each of the four recording processes and the worker 10 times; 50 times if `long`.

    On a slow machine there are fewer kills, but together at least 10 of them. If `long`, all are made.
    """
    recording, working = (
        (KillCount(200, 200, 0.0), KillCount(50, 50, 0.0))
        if long
        else (KillCount(40, _LEAST_KILLS[0], _KILLED_S[0]), KillCount(10, _LEAST_KILLS[1], _KILLED_S[1]))
    )
    lab = recording_station.PatientLab(_made(folder / "kills"))
    try:
        lab.node(*recording_station.SIZE).server()
        lab.up(*PATIENT)
        rows = kill_recording(lab, recording, seed)
    finally:
        lab.close()
    data = folder / "published"  # separate: interrupted episodes are not published before they are scored
    make_episodes(data, frames)
    return {"rows": [*rows, *kill_worker(data, working, seed)]}


def _listing(data: Path) -> dict[str, Any]:
    return _child(
        sys.executable, "recording_listing", str(_LISTED), EVA_DATA_DIR=str(data), EVA_LOG_LEVEL="ERROR"
    )
