"""Conversion of chunks of poses to joints: duration, accuracy and joint speeds, for all robots and installed backends.

It runs on one core, because a station uses the others. All backends solve the same chunks in turn, slow ones less
often.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import robots
from benchmarks.ik_paths import OUT_OF_REACH, ROWS, Chunk, arm_dims, invented, recorded
from benchmarks.ik_postures import PATHS, SETTLED, drift, path, redundant, worst
from benchmarks.labs import ROOT
from benchmarks.report import Figure, Report
from robots import Robot
from runtime.core.errors import SetupError
from runtime.core.plugins import variants
from runtime.kinematics.base import IkFlag, IkResult, Kinematics

SECONDS = 0.5
_DEFAULT = "compiled"
_FEWEST = 3  # calls of a backend per chunk
_PATIENCE_S = 1.0  # time for these; after it, one call per chunk is enough
_STARTS = 3
_RECORDED = "agilex_piper"  # the robot of $EVA_SAMPLE_EPISODE
_EPISODE = "EVA_SAMPLE_EPISODE"


def measure(seconds: float) -> Report:
    """Measure `chunk_ms.ROBOT.TRAJECTORY` and the quality of solutions.

    Figures of backends other than the default end with the backend's kind.
    """
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        rows = [row for name in robots.robot_names() for row in _robot(name, seconds)]
        figures = [figure for row in rows for figure in _figures(row)]
        figures += _compared(rows)
        figures += [figure for name in robots.robot_names() for figure in _postures(name)]
        figures.append(
            Figure("limit_violations", sum(row["violations"] for row in rows if _ours(row)), "", "== 0")
        )
        figures += _fk() + _starts()
    finally:
        os.sched_setaffinity(0, allowed)
    return Report("ik", figures, rows)


def _robot(name: str, seconds: float) -> list[dict[str, Any]]:
    """Return the rows of one robot, one per trajectory and backend."""
    robot = robots.load_robot(name)
    cases = invented(robot)
    folder = os.environ.get(_EPISODE)
    if name == _RECORDED and folder:
        cases["recorded"] = recorded(Path(folder)).chunks(robot)
    backends = _backends(robot)
    return [
        {"robot": name, "trajectory": trajectory, "arms": len(robot.arms), "joints": _joints(robot), **row}
        for trajectory, chunks in cases.items()
        for row in _case(robot, backends, chunks, seconds)
    ]


def _joints(robot: Robot) -> int:
    """Return the largest number of joints of an arm."""
    return max(len(arm.joint_dims) for arm in robot.arms)


def _backends(robot: Robot) -> dict[str, Kinematics]:
    """Return by kind the backends that are available here, ready to solve."""
    built = {}
    for kind, module in variants("runtime.kinematics").items():
        try:
            built[kind] = module.build(module.Config(), robot)
        except SetupError as error:
            print(f"{robot.name}: {kind} is not measured: {error}", file=sys.stderr)
    return built


def _case(
    robot: Robot, backends: Mapping[str, Kinematics], chunks: Sequence[Chunk], seconds: float
) -> list[dict[str, Any]]:
    """Let the backends solve the chunks in turn, and return a row per backend.

    A backend stops when it has used its time and has solved each chunk often enough. `seconds` is the time of each
    backend.
    """
    solved = {kind: [_solved(backend, chunk) for chunk in chunks] for kind, backend in backends.items()}
    times: dict[str, list[_Call]] = {kind: [] for kind in backends}
    while due := [kind for kind in backends if not _enough(times[kind], len(chunks), seconds)]:
        for chunk in chunks:
            for kind in due:
                begun, used = time.perf_counter(), time.process_time()
                _solved(backends[kind], chunk)
                times[kind].append(_Call(time.perf_counter() - begun, time.process_time() - used))
    return [
        {"kind": kind, **_timed(times[kind], len(robot.arms)), **_judged(robot, chunks, solved[kind])}
        for kind in backends
    ]


class _Call(NamedTuple):
    """Duration of one call [s]: wall time and processor time."""

    took: float
    used: float


def _enough(calls: Sequence[_Call], chunks: int, seconds: float) -> bool:
    """Return True if the calls of a backend are sufficient for the measurement.

    They are if they took at least `seconds` in total, with at least _FEWEST calls per chunk. For a slow backend, one
    call per chunk is sufficient once the calls took _PATIENCE_S.
    """
    took = sum(call.took for call in calls)
    if len(calls) < _FEWEST * chunks:
        return len(calls) >= chunks and took >= _PATIENCE_S
    return took >= seconds


def _solved(backend: Kinematics, chunk: Chunk) -> IkResult:
    return backend.solve(chunk.targets, chunk.seed, chunk.dt, chunk.seed, 0)


def _timed(calls: Sequence[_Call], arms: int) -> dict[str, float]:
    took, used = np.array(calls).T * 1e3
    return {
        "chunk_ms": float(np.median(took)),
        "arm_ms": float(np.median(took)) / arms,
        "chunk_ms_p99": float(np.percentile(took, 99)),
        "chunk_cpu_ms": float(np.median(used)),
    }


def _judged(robot: Robot, chunks: Sequence[Chunk], solved: Sequence[IkResult]) -> dict[str, float]:
    """Return the quality of the solutions over all chunks; the speed of the first row is relative to the seed.

    For reachable targets, errors are taken only from frames that are at neither a joint limit nor a velocity limit; the
    share of the other frames and their errors are reported separately.
    """
    dims = arm_dims(robot)
    q = np.stack([result.q for result in solved])[..., dims]
    seeds = np.stack([np.clip(chunk.seed, robot.lower, robot.upper) for chunk in chunks])[:, dims]
    steps = np.abs(np.diff(np.concatenate([seeds[:, None], q], axis=1), axis=1))
    away = np.stack([result.position_error for result in solved]) * 1e3
    turned = np.degrees(np.stack([result.rotation_error for result in solved]))
    constrained = np.stack([result.flags for result in solved]) & (IkFlag.AT_LIMIT | IkFlag.AT_VELOCITY) != 0
    free = ~constrained if chunks[0].reachable else np.ones_like(constrained)
    return {
        "position_error_mm": float(away[free].max()),
        "position_error_mean_mm": float(away[free].mean()),
        "rotation_error_deg": float(turned[free].max()),
        "rotation_error_mean_deg": float(turned[free].mean()),
        "held_share": float(constrained.mean()),
        "position_error_held_mm": float(away[constrained].max(initial=0.0)),
        "largest_step": float(steps.max()),
        "velocity_ratio": float((steps / chunks[0].dt / robot.velocity[dims]).max()),
        "violations": int(((q < robot.lower[dims]) | (q > robot.upper[dims])).sum()),
    }


def _ours(row: Mapping[str, Any]) -> bool:
    return bool(row["kind"] == _DEFAULT)


def _figures(row: Mapping[str, Any]) -> list[Figure]:
    """Return the figures of a row; only those of the default backend have requirements."""
    case = f"{row['robot']}.{row['trajectory']}" + ("" if _ours(row) else f".{row['kind']}")
    reachable = row["trajectory"] != OUT_OF_REACH
    allowed = {"chunk_ms": "<= 0.5" if reachable else "<= 1", "velocity_ratio": "<= 1"}
    if reachable:
        allowed["arm_ms"] = "<= 0.2" if row["joints"] > 6 else "<= 0.1"
    if reachable:
        exact = "<= 0.01" if row["trajectory"] == "smooth" else "<= 0.05"
        allowed |= {"position_error_mm": exact, "rotation_error_deg": "<= 0.02"}
    units = {
        "chunk_ms": "ms",
        "arm_ms": "ms",
        "chunk_ms_p99": "ms",
        "chunk_cpu_ms": "ms",
        "position_error_mm": "mm",
        "position_error_mean_mm": "mm",
        "rotation_error_deg": "deg",
        "rotation_error_mean_deg": "deg",
        "held_share": "",
        "position_error_held_mm": "mm",
        "largest_step": "rad",
        "velocity_ratio": "",
    }
    return [
        Figure(f"{name}.{case}", row[name], unit, allowed.get(name, "") if _ours(row) else "")
        for name, unit in units.items()
    ]


def _postures(name: str) -> list[Figure]:
    """Return figures of the default backend on loops and long paths.

    Figures with `far` are of paths with one leg only, to a posture anywhere within the limits. For figures with
    `chunks`, a path is solved chunk by chunk, so that only the current chunk is known.
    """
    robot = robots.load_robot(name)
    module = variants("runtime.kinematics")[_DEFAULT]
    kinematics = module.build(module.Config(), robot)
    paths, far = ([path(robot, i, *legs) for i in range(PATHS)] for legs in ((), (1, np.inf)))
    missed = np.array([worst(robot, kinematics, joints) for joints in paths]) * 1e3
    chunked = np.array([worst(robot, kinematics, joints, ROWS) for joints in paths]) * 1e3
    gone = np.array([worst(robot, kinematics, joints) for joints in far]) * 1e3
    figures = [
        Figure(f"reachable_missed_mm.{name}", float(missed.max()), "mm", "<= 1"),
        Figure(f"reachable_missed_share.{name}.chunks", float((chunked > 1).mean()), ""),
        Figure(f"reachable_missed_share.{name}.far", float((gone > 1).mean()), ""),
    ]
    if redundant(robot):
        loops = drift(robot, kinematics)
        figures += [
            Figure(f"drift_rad_per_loop.{name}", float(loops[:, SETTLED:].max()), "rad", "< 0.005"),
            Figure(f"drift_rad_first_loop.{name}", float(loops[:, 0].max()), "rad"),
        ]
    return figures


def _compared(rows: Sequence[Mapping[str, Any]]) -> list[Figure]:
    """Return the processor time of each other backend as a multiple of the default backend's.

    Wall time would depend on the machine's load, and more so for long calls.
    """
    own_ms = {(row["robot"], row["trajectory"]): row["chunk_cpu_ms"] for row in rows if _ours(row)}
    return [
        Figure(
            f"ratio.{row['robot']}.{row['trajectory']}.{row['kind']}", row["chunk_cpu_ms"] / own_ms[key], "x"
        )
        for row in rows
        if not _ours(row) and (key := (row["robot"], row["trajectory"])) in own_ms
    ]


def _fk() -> list[Figure]:
    """Return the distance between recorded poses and the poses computed from the joints recorded with them."""
    folder = os.environ.get(_EPISODE)
    if not folder:
        print(f"the recorded episode is not measured: {_EPISODE} is not set", file=sys.stderr)
        return []
    robot, recording = robots.load_robot(_RECORDED), recorded(Path(folder))
    module = variants("runtime.kinematics")[_DEFAULT]
    poses = module.build(module.Config(), robot).forward(recording.joints)
    away = np.linalg.norm(poses[..., :3] - recording.poses[..., :3], axis=-1) * 1e3
    cosine = np.abs(np.sum(poses[..., 3:] * recording.poses[..., 3:], axis=-1))
    turned = np.degrees(2 * np.arccos(np.minimum(1.0, cosine)))
    return [
        Figure("real_episode_fk_mm", float(away.max()), "mm", "<= 0.15"),
        Figure("real_episode_fk_deg", float(turned.max()), "deg"),
    ]


def _starts() -> list[Figure]:
    """Measure the time from the start of a process to its first chunk, with an empty and with a filled cache.

    Processor time is reported, too, because it is independent of the machine's load.
    """
    name = _RECORDED if _RECORDED in robots.robot_names() else robots.robot_names()[0]
    with tempfile.TemporaryDirectory() as folder:
        cold = _first_chunk(name, folder)
        warm = [_first_chunk(name, folder) for _ in range(_STARTS)]
    typical = {key: float(np.median([start[key] for start in warm])) for key in cold}
    return [
        Figure("cold_start_s.cold", cold["seconds"], "s"),
        Figure("cold_start_s.warm", typical["seconds"], "s", "< 1.5"),
        Figure("cold_start_cpu_s.cold", cold["cpu_s"], "s"),
        Figure("cold_start_cpu_s.warm", typical["cpu_s"], "s"),
        Figure("rss_mb.cold", cold["rss_mb"], "MB"),
        Figure("rss_mb.warm", typical["rss_mb"], "MB"),
    ]


def _first_chunk(name: str, cache: str) -> dict[str, float]:
    command = [sys.executable, "-m", "benchmarks.first_chunk", _DEFAULT, name]
    environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
    used, begun = _children_s(), time.perf_counter()
    with subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        timings: dict[str, float] = json.loads(process.stdout.readline())
        timings["seconds"] = time.perf_counter() - begun
    timings["cpu_s"] = _children_s() - used
    return timings


def _children_s() -> float:
    """Return the processor time of the child processes that have ended [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
