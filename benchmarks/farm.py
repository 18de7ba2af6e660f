"""Trials at simulated benches in processes of their own: speed, throughput of one and of two workers, and agreement.

Each trial is `runtime.standins.trial` in a process of its own, started as copies of a station are: node, bench with
contact forces, policy server and station in one process, with recording. The policy is scripted and answers in under a
millisecond, so that servers are no part of this.

* `speed_ratio.2_cameras`, `speed_ratio.3_cameras`: the run's time over the time that it took, for pictures of 224x224;
  all cameras of the robot are drawn, shown to the policy, encoded and recorded.
* `speed_ratio.640x480`: the same for three cameras of 640x480.
* `trials_per_hour.1`, `trials_per_hour.2`: trials of `seconds` with one and two workers, start and set-up included.
* `scaling_2_workers`: quotient of these two.
* `disagreements`: trials whose recorded rows or pictures with two workers differ in any bit from those with one.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from benchmarks.report import Figure, Report
from evaweb.plans.trial_processes import TrialProcesses
from runtime.recording.reader import open_episode

_TRIALS = 8
_SMALL = (224, 224)
_CASES = {  # name -> deployment, robot, size of the pictures
    "2_cameras": ("tabletop_ur5e", "ur5e", _SMALL),
    "3_cameras": ("tabletop", "agilex_piper", _SMALL),
    "640x480": ("tabletop", "agilex_piper", (640, 480)),
}
_PROCESSES = TrialProcesses(
    dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
)


def measure(seconds: float) -> Report:
    """Run single trials, then the same trials with one and with two workers; each run lasts `seconds`, virtually."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        figures = [
            Figure(
                f"speed_ratio.{case}",
                _speed(_trial(folder / case, case, 0, seconds)),
                "",
                ">= 10" if case == "2_cameras" else "",
            )
            for case in _CASES
        ]
        digests, per_hour = {}, {}
        for workers in (1, 2):
            begun = time.monotonic()
            with ThreadPoolExecutor(workers) as pool:
                done = list(
                    pool.map(
                        lambda seed, workers=workers: _trial(
                            folder / f"{workers}-{seed}", "3_cameras", seed, seconds
                        ),
                        range(_TRIALS),
                    )
                )
            per_hour[workers] = 3600.0 * _TRIALS / (time.monotonic() - begun)
            digests[workers] = [_digest(Path(result["episode"]["path"])) for result in done]
            figures.append(Figure(f"trials_per_hour.{workers}", per_hour[workers], ""))
    differing = [seed for seed in range(_TRIALS) if digests[1][seed] != digests[2][seed]]
    figures += [
        Figure("scaling_2_workers", per_hour[2] / per_hour[1], "", ">= 1.8"),
        Figure("disagreements", float(len(differing)), "", "== 0"),
    ]
    rows = [{"seed": seed, "digest": digests[1][seed]} for seed in range(_TRIALS)]
    return Report("farm", figures, [*rows, {"differing": differing}])


def _trial(folder: Path, case: str, seed: int, seconds: float) -> Mapping[str, Any]:
    """Run one trial in a process of its own and return its result."""
    deployment, robot, (width, height) = _CASES[case]
    orders = {
        "setup": {
            "task": "put the block on the plate",
            "policy": {"delay_ms": 80},
            "bench": {"id": f"{case}-{seed}", "seed": seed, "positions": None},
        },
        "run": {"mode": "continuous", "duration_s": seconds, "trial": {}},
    }
    sets = [f'data_dir="{folder}"', "recording.min_free_bytes=0"]
    arguments = [f"deployments/{deployment}.toml", "--lifeline"]
    arguments += [part for assignment in sets for part in ("--set", assignment)]
    arguments += [
        "--serve",
        f"openpi --robot {robot} --port 0",
        "--width",
        str(width),
        "--height",
        str(height),
    ]
    folder.mkdir(parents=True)
    process = _PROCESSES.start(arguments, folder / "log")
    try:
        process.input.write(json.dumps(orders).encode() + b"\n")
        process.input.flush()
        answer, code = process.output.read(), process.wait()
    finally:
        process.close()
    if code:
        raise RuntimeError(f"a trial ended with {code}: {(folder / 'log').read_text()[-500:]}")
    result: Mapping[str, Any] = json.loads(answer)
    return result


def _speed(result: Mapping[str, Any]) -> float:
    """Return the duration of the run over the time that it took."""
    ends = [
        event
        for event in result["events"]
        if event["kind"] in ("episode_opened", "state") and event["time"] is not None
    ]
    opened = next(at for at, event in enumerate(ends) if event["kind"] == "episode_opened")
    first, last = ends[opened], ends[opened + 1]
    return float((last["time"] - first["time"]) / (last["wall"] - first["wall"]))


def _digest(path: Path) -> str:
    """Return the digest of everything that an episode's streams and videos contain."""
    content, episode = hashlib.sha256(), open_episode(path)
    for table in (episode.raw, episode.smoothed, episode.rows, episode.ticks):
        for name in table.column_names:
            content.update(f"{name}\n{table[name].to_pylist()}".encode())
    for video in sorted(path.glob("*.mp4")):
        content.update(video.read_bytes())
    return content.hexdigest()
