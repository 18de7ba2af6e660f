"""Smoothness of the arms in a run: SPARC of the speed of each end effector, measured and commanded.

SPARC was made for the speed of a hand (Balasubramanian et al. 2015), and is comparable between robots with different
joints. Positions are computed from the joints by the robot's description, and only for times in which the robot was
asked to move: a robot held for its operator is not jerky. The result of a run is the value of the measured motion, at
capture times. The value of the commanded motion is reported in addition: it is free of sensor noise and of smoothing by
the robot's own controller.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaweb.core.errors import NotFound
from evaweb.episodes.curves import vectors
from evaweb.episodes.manifest_robot import robot_for
from evaweb.statistics.base import StatisticsError
from evaweb.statistics.smoothness import CUT_OFF, sparc
from runtime.kinematics.base import ChainForward
from runtime.recording.reader import Episode, open_episode
from runtime.recording.scrub import require_intact
from runtime.recording.summary import HELD

LEAST_M = 0.02  # least extent of motion; below it the speed is sensor noise
Array = NDArray[np.float64]
_STREAMS = ("measured", "commanded")
_FILES = ("manifest.json", "rows.arrow", "ticks.arrow")
_LEAST_RATE = 0.95 * 2 * CUT_OFF  # least rate of observations [1/s]; tolerates occasional losses


@dataclass(frozen=True, slots=True)
class Smoothness:
    """Smoothness of a run: means over its arms, weighted by path length.

    Attributes:
        measured: SPARC of the measured motion, None if unknown.
        commanded: SPARC of the commanded motion, None if unknown.
        arms: For each arm that moved, by name: "measured" and "commanded" (SPARC or None), and "measured_m" and
            "commanded_m" (path length [m]).
        why: Reason for an unknown measured value, else "".
    """

    measured: float | None
    commanded: float | None
    arms: Mapping[str, Mapping[str, float | None]]
    why: str = ""


def smoothness_in(folder: Path) -> Smoothness:
    """Return the smoothness of a recording. Raises: RecordingError, which names the absent or damaged file."""
    require_intact(folder, _FILES)
    return smoothness_of(open_episode(folder, videos=False))


def smoothness_of(episode: Episode) -> Smoothness:
    """Return the smoothness of an open episode."""
    try:
        robot = robot_for(episode.manifest)
    except NotFound as error:
        return _none(str(error))
    if not robot.arms:
        return _none(f"{robot.name} has no arm whose end effector has a known place")
    rate = episode.manifest.get("control_rate")
    if not isinstance(rate, int | float) or rate < 2 * CUT_OFF:
        return _none(
            f"control_rate = {rate!r}: SPARC looks at up to {CUT_OFF:g} Hz, which takes twice the rate"
        )
    forward = ChainForward(robot)
    measured = _tip_track(_measured(episode), float(rate), forward)
    observed_rate = measured.seen
    if observed_rate is not None and observed_rate < _LEAST_RATE:
        measured = replace(measured, spans=())
    arms: dict[str, dict[str, float | None]] = {arm.name: {} for arm in robot.arms}
    for stream, track in (
        ("measured", measured),
        ("commanded", _tip_track(_commanded(episode, rate), float(rate), forward)),
    ):
        for index, arm in enumerate(robot.arms):
            path = _path_lengths(track.spans, index)
            arms[arm.name] |= {stream: _sparc(path, float(rate)), f"{stream}_m": float(path.sum())}
    moved = {
        name: facts for name, facts in arms.items() if any(facts[stream] is not None for stream in _STREAMS)
    }
    result = Smoothness(_mean(moved, "measured"), _mean(moved, "commanded"), moved)
    if result.measured is not None:
        return result
    if observed_rate is not None and observed_rate < _LEAST_RATE:
        return replace(
            result,
            why=f"{observed_rate:.0f} observations a second: SPARC looks at up to {CUT_OFF:g} Hz, "
            "which takes twice that",
        )
    return replace(result, why=f"no arm moved farther than {LEAST_M * 1000:.0f} mm while it was asked to")


def _none(reason: str) -> Smoothness:
    return Smoothness(None, None, {}, reason)


@dataclass(frozen=True, slots=True)
class _Samples:
    """Samples of the robot's joints.

    Attributes:
        times: Time of each sample [N] [s].
        joints: Joint positions [N, D], NaN if unknown.
        asked: Whether the robot was asked to move at each sample [N].
    """

    times: Array
    joints: Array
    asked: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class _TipTrack:
    """Positions of all end effectors at the control rate.

    `spans` has one array [steps, arms, 3] for each uninterrupted motion. The positions are linearly interpolated
    between samples. `seen` is the number of samples per second, None without samples.
    """

    spans: tuple[Array, ...]
    seen: float | None


def _measured(episode: Episode) -> _Samples:
    """Return the joints that the robot measured, at their capture times.

    Each tick recorded the newest sample at that time, however old it was.
    """
    rows, name = episode.rows, "capture_time.joints"
    ticked = rows.column("tick_time").to_numpy()
    captured = rows.column(name).to_numpy(zero_copy_only=False) if name in rows.column_names else ticked
    times = np.asarray(captured if np.isfinite(captured.astype(float)).any() else ticked, np.float64)
    joints = vectors(rows, "qpos", episode.layout.dim).T.astype(np.float64)
    joints[np.diff(rows.column("sequence").to_numpy(), prepend=-1) == 0] = np.nan  # repeated sample
    return _Samples(times, joints, _asked(rows))


def _commanded(episode: Episode, rate: float) -> _Samples:
    """Return the commanded joints at the times of their control steps."""
    ticks = episode.ticks
    joints = vectors(ticks, "executed", episode.layout.dim).T.astype(np.float64)
    return _Samples(ticks.column("step").to_numpy() / rate, joints, _asked(ticks))


def _asked(table: Any) -> NDArray[np.bool_]:
    return np.array([source not in HELD for source in table.column("control_source").to_pylist()], bool)


def _tip_track(samples: _Samples, rate: float, forward: ChainForward) -> _TipTrack:
    valid = np.isfinite(samples.joints).all(axis=1) & np.isfinite(samples.times)
    spans, count, duration = [], 0, 0.0
    edges = np.flatnonzero(np.diff(np.concatenate([[0], samples.asked.astype(np.int8), [0]])))
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        indices = first + np.flatnonzero(valid[first:end])
        at = samples.times[indices]
        later = at > np.concatenate([[-np.inf], np.maximum.accumulate(at)[:-1]])
        indices, at = indices[later], at[later]
        if len(indices) < 2:
            continue
        count, duration = count + len(indices) - 1, duration + float(at[-1] - at[0])
        places = forward.forward(samples.joints[indices])[..., :3]
        grid = at[0] + np.arange(int((at[-1] - at[0]) * rate + 1e-6) + 1) / rate
        every = [np.interp(grid, at, places[:, a, x]) for a in range(places.shape[1]) for x in range(3)]
        spans.append(np.stack(every, axis=-1).reshape(len(grid), places.shape[1], 3))
    return _TipTrack(tuple(spans), count / duration if duration > 0 else None)


def _path_lengths(spans: Sequence[Array], arm: int) -> Array:
    """Return the distance that the arm's end effector moved in each step [m]; empty if it did not move."""
    if not spans:
        return np.empty(0)
    places = np.concatenate([span[:, arm] for span in spans])
    if np.linalg.norm(np.ptp(places, axis=0)) < LEAST_M:
        return np.empty(0)
    return np.concatenate([np.linalg.norm(np.diff(span[:, arm], axis=0), axis=1) for span in spans])


def _sparc(path: Array, rate: float) -> float | None:
    try:
        return sparc(path.tolist(), rate)
    except StatisticsError:  # no motion, or too short
        return None


def _mean(arms: Mapping[str, Mapping[str, float | None]], stream: str) -> float | None:
    rows = [(facts[stream], facts[f"{stream}_m"] or 0.0) for facts in arms.values()]
    valued = [(value, length) for value, length in rows if value is not None]
    return (
        sum(value * length for value, length in valued) / sum(length for _, length in valued)
        if valued
        else None
    )
