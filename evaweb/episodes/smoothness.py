"""How smoothly the arms of a run moved: SPARC of the speed of each end effector, as measured and as it was sent.

The speed of the hand is what SPARC was made for (Balasubramanian et al. 2015), and it means the same for robots with
other joints. Positions follow from the joints by the robot's description, at the control steps in which somebody asked
for something: a robot that is held for its operator is not jerky. The measured one counts; the sent one, beside it, is
free of the sensors' noise and of what the robot's own controller smooths.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evaweb.episodes.curves import vectors
from evaweb.episodes.robot import described_in
from evaweb.errors import NotFound
from evaweb.statistics.base import StatisticsError
from evaweb.statistics.smoothness import CUT_OFF, sparc
from runtime.kinematics.forward import ChainForward
from runtime.recording.reader import Episode, open_episode
from runtime.recording.summary import HELD

LEAST_M = 0.02  # an arm that stays within it did not move: its speed is the noise of its sensors
Array = NDArray[np.float64]
_STREAMS = {"measured": "qpos", "commanded": "executed"}


@dataclass(frozen=True, slots=True)
class Smoothness:
    """Of a run: the mean over its arms, each as heavy as its way is long; None with `why` where there is none.

    `arms`: name -> {"measured", "commanded": SPARC or null, "measured_m", "commanded_m": the way}, those that moved.
    """

    measured: float | None
    commanded: float | None
    arms: Mapping[str, Mapping[str, float | None]]
    why: str = ""


def smoothness_in(folder: Path) -> Smoothness:
    """That of a recording; RecordingError names the file that is absent or damaged."""
    return smoothness_of(open_episode(folder))


def smoothness_of(episode: Episode) -> Smoothness:
    """The same of an episode that is open already."""
    try:
        robot = described_in(episode.manifest)
    except NotFound as error:
        return _none(str(error))
    rate = episode.manifest.get("control_rate")
    if not isinstance(rate, int | float) or rate < 2 * CUT_OFF:
        return _none(
            f"control_rate = {rate!r}: SPARC looks at up to {CUT_OFF:g} Hz, which takes twice the rate"
        )
    forward = ChainForward(robot)
    arms: dict[str, dict[str, float | None]] = {arm.name: {} for arm in robot.arms}
    for stream, column in _STREAMS.items():
        spans = _moved(episode, column, forward)
        for index, arm in enumerate(robot.arms):
            way = _way(spans, index)
            arms[arm.name] |= {stream: _sparc(way, float(rate)), f"{stream}_m": float(way.sum())}
    moved = {
        name: facts for name, facts in arms.items() if any(facts[stream] is not None for stream in _STREAMS)
    }
    why = "" if moved else f"no arm moved farther than {LEAST_M * 1000:.0f} mm while it was asked to"
    return Smoothness(_mean(moved, "measured"), _mean(moved, "commanded"), moved, why)


def _none(why: str) -> Smoothness:
    return Smoothness(None, None, {}, why)


def _moved(episode: Episode, column: str, forward: ChainForward) -> list[Array]:
    """Positions of all end effectors [steps, arms, 3], at every step from the first to the last, span by span.

    A span is as long as the robot was asked to move without a pause. Steps that were missed, or at which nothing new
    was measured, lie on the straight line between those beside them.
    """
    ticks = episode.ticks
    steps = ticks.column("step").to_numpy()
    asked = np.array([source not in HELD for source in ticks.column("control_source").to_pylist()], bool)
    joints = vectors(ticks, column, episode.layout.dim).T.astype(np.float64)
    known = np.isfinite(joints).all(axis=1)
    if column == "qpos":
        known &= np.diff(ticks.column("sequence").to_numpy(), prepend=-1) != 0
    spans = []
    edges = np.flatnonzero(np.diff(np.concatenate([[0], asked.astype(np.int8), [0]])))
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        there = first + np.flatnonzero(known[first:end])
        if len(there) < 2:
            continue
        at = steps[there]
        places = forward.forward(joints[there])[..., :3]
        grid = np.arange(at[0], at[-1] + 1)
        every = [np.interp(grid, at, places[:, a, x]) for a in range(places.shape[1]) for x in range(3)]
        spans.append(np.stack(every, axis=-1).reshape(len(grid), places.shape[1], 3))
    return spans


def _way(spans: list[Array], arm: int) -> Array:
    """How far the arm's end effector went in each step [m]; empty where it did not move."""
    if not spans:
        return np.empty(0)
    places = np.concatenate([span[:, arm] for span in spans])
    if np.linalg.norm(np.ptp(places, axis=0)) < LEAST_M:
        return np.empty(0)
    return np.concatenate([np.linalg.norm(np.diff(span[:, arm], axis=0), axis=1) for span in spans])


def _sparc(way: Array, rate: float) -> float | None:
    try:
        return sparc(way.tolist(), rate)
    except StatisticsError:  # it did not move, or not for long enough
        return None


def _mean(arms: Mapping[str, Mapping[str, float | None]], stream: str) -> float | None:
    rows = [(facts[stream], facts[f"{stream}_m"] or 0.0) for facts in arms.values()]
    known = [(value, way) for value, way in rows if value is not None]
    return sum(value * way for value, way in known) / sum(way for _, way in known) if known else None
