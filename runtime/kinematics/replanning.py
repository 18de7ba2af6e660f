"""Another plan for a chunk of which poses are missed, or that ends cramped, found from its end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from runtime.core.types import Float64
from runtime.kinematics.base import IkResult

_SAME = 0.01  # rad (m) within which two ends are one
_HOPELESS = 4  # postures without a solution after which the last pose is taken to have none
_FOLLOWED = 12  # ends at most that are followed back
_ENDLESS = np.pi  # rad to either side in which joints without limits are tried

# Share of the range that redundant joints keep: a solution with less may leave none for the next chunk.
MIN_LIMIT_MARGIN = 0.3
ROOMIER = 0.1  # of it that another posture must have more

SolveRows = Callable[
    ..., IkResult
]  # poses [T, 1, 7], seed [D], dt, anchor [D], anchor_row, guide [T, D]: frame by frame


LimitMargin = Callable[
    [Float64], float
]  # joints [D]: how far the one nearest to a limit is from it, where it has a choice


def sample_postures(home: Float64, lower: Float64, upper: Float64, count: int) -> Float64:
    """Joints [1 + count, n] to look for ends from: home, and others anywhere within the limits.

    The same ones each time, so that the same question has the same answer.
    """
    low, high = np.maximum(lower, -_ENDLESS), np.minimum(upper, _ENDLESS)
    return np.vstack([home, np.random.default_rng(1).uniform(low, high, (count, len(home)))])


def arms_missing_targets(result: IkResult, begin: int) -> NDArray[np.intp]:
    """The arms that meet the pose of row `begin`, and not all of those behind it."""
    reached = result.reached[begin:]
    return np.flatnonzero(reached[0] & ~reached.all(axis=0)) if len(reached) else np.empty(0, np.intp)


def replan(
    sweep: SolveRows,
    poses: Float64,
    start: Float64,
    dt: float,
    dims: NDArray[np.intp],
    starts: Float64,
    room: LimitMargin,
    least: float = -np.inf,
) -> IkResult | None:
    """A plan for poses [T, 1, 7] of the arm at `dims`, from `start` [D] on, that misses none; None if none is found.

    At its end the joints [D] have more than the `least` room.

    Frames that are solved one after the other may take a branch, or a posture, that ends before the poses do. So the
    last pose is solved from `starts` [S, n], each solution is followed back to the first pose, and what that gives
    guides a plan forwards: it comes as close to its guide as half of the velocities let it, the nearest end first.
    """
    ends = (end for end in _ends(sweep, poses[-1:], start, dims, starts) if room(end) > least)
    for end in islice(ends, _FOLLOWED):
        back = sweep(np.ascontiguousarray(poses[::-1]), end, dt, end, 0)
        plan = sweep(poses, start, dt, start, 0, np.ascontiguousarray(back.q[::-1]))
        if plan.reached.all() and room(plan.q[-1]) > least:
            return plan
    return None


def _ends(
    sweep: SolveRows, last: Float64, start: Float64, dims: NDArray[np.intp], starts: Float64
) -> Iterator[Float64]:
    """Joints [D] for the last pose [1, 1, 7], the nearest to `start` first, none twice."""
    found: list[Float64] = []
    for tried, posture in enumerate(starts):
        if tried == _HOPELESS and not found:
            return
        seed = start.copy()
        seed[dims] = posture
        solved = sweep(last, seed, None, seed, -1)
        if solved.reached.all():
            found.append(solved.q[0])
    taken: list[Float64] = []
    for end in sorted(found, key=lambda q: float(np.abs(q - start).max())):
        if all(np.abs(end - other).max() > _SAME for other in taken):
            taken.append(end)
            yield end
