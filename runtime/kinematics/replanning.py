"""Replanning of a chunk that misses poses or ends near limits.

The search begins with the last pose of the chunk and goes backwards to the first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from runtime.core.types import Float64
from runtime.kinematics.base import IkResult

_SAME = 0.01  # [rad, m] distance within which two ends are the same
_HOPELESS = 4  # failed postures after which the last pose counts as unreachable
_FOLLOWED = 12  # ends from which a plan is tried at most
_ENDLESS = np.pi  # [rad] range to either side in which joints without limits are sampled

# Least margin of redundant joints at the end, as a share: with less the next chunk may have no solution.
MIN_LIMIT_MARGIN = 0.3
ROOMIER = 0.1  # share by which another posture's margin must be larger

SolveRows = Callable[..., IkResult]  # poses [T, 1, 7], seed [D], dt, anchor [D], anchor_row, guide [T, D]


LimitMargin = Callable[[Float64], float]  # joints [D] -> margin to the nearest limit of redundant joints


def sample_postures(home: Float64, lower: Float64, upper: Float64, count: int) -> Float64:
    """Return joints [1 + count, n] from which end postures are searched: home, and random ones within the limits.

    The sample is always the same, so that equal problems have equal solutions.
    """
    low, high = np.maximum(lower, -_ENDLESS), np.minimum(upper, _ENDLESS)
    return np.vstack([home, np.random.default_rng(1).uniform(low, high, (count, len(home)))])


def arms_missing_targets(result: IkResult, begin: int) -> NDArray[np.intp]:
    """Return the indices of arms that reach row `begin` but miss a later row."""
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
    """Return a plan that reaches all of `poses` [T, 1, 7] with one arm; None if no plan is found.

    Frames solved in sequence may follow a branch, or a posture, that cannot reach all poses. So the last pose is solved
    from several joints, each solution is followed back to the first pose, and the result guides a plan forwards, which
    approaches its guide with half of the joint velocities. The end nearest to `start` is tried first.

    Args:
        sweep: Solver of poses in sequence for this arm.
        poses: Poses of the arm.
        start: Joints [D] from which the plan begins.
        dt: Time between poses [s].
        dims: Indices of the arm's joints in the robot's vector [n].
        starts: Joints of the arm [S, n] from which the last pose is solved.
        room: Function that returns the margin of joints [D] to the nearest limit.
        least: Bound that the margin of the plan's last joints must exceed.
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
    """Yield distinct joints [D] that reach the last pose [1, 1, 7], the nearest to `start` first."""
    solutions: list[Float64] = []
    for tried, posture in enumerate(starts):
        if tried == _HOPELESS and not solutions:
            return
        seed = start.copy()
        seed[dims] = posture
        solved = sweep(last, seed, None, seed, -1)
        if solved.reached.all():
            solutions.append(solved.q[0])
    distinct: list[Float64] = []
    for end in sorted(solutions, key=lambda q: float(np.abs(q - start).max())):
        if all(np.abs(end - earlier).max() > _SAME for earlier in distinct):
            distinct.append(end)
            yield end
