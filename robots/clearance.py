"""Distances of a robot's links from each other and from the table; a coarse check with capsules."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from robots.body import Body
from robots.capsules import capsules
from robots.description import TABLE
from robots.robot import Robot
from robots.rotations import Float64

_TINY = 1e-300  # avoids division by zero
_PARALLEL = (
    1e-12  # squared sine of the angle below which segments count as parallel: any starting point will do
)


def segment_distances(start: Float64, way: Float64, other: Float64, other_way: Float64) -> Float64:
    """Return the distances [...] between the segments from `start` along `way` and those from `other` along
    `other_way`.

    All arguments are [..., 3]. The closest points of the two lines are clamped to the segments one after the other
    (Ericson, Real-Time Collision Detection, 5.1.9); segments may be points, and parallel.
    """
    between = start - other
    a, e = _dot(way, way), _dot(other_way, other_way)
    b, c, f = _dot(way, other_way), _dot(way, between), _dot(other_way, between)
    area = a * e - b * b
    slanting = area > _PARALLEL * a * e
    s = np.where(slanting, np.clip((b * f - c * e) / np.where(slanting, area, 1.0), 0.0, 1.0), 0.0)
    t = np.clip((b * s + f) / np.maximum(e, _TINY), 0.0, 1.0)
    s = np.clip((b * t - c) / np.maximum(a, _TINY), 0.0, 1.0)
    apart = between + s[..., None] * way - t[..., None] * other_way
    return np.asarray(np.sqrt(_dot(apart, apart)))


def _dot(first: Float64, second: Float64) -> Float64:
    return np.asarray(np.einsum("...i,...i->...", first, second))


MARGIN = 0.005  # [m] default distance below which links count as touching
_POSTURES = 256  # random postures for finding links that always touch
_NEARLY_ALWAYS = 0.95  # share of postures
_LEVEL = 1e-3  # [m] change of height below which a part only rotates about the vertical
_DIP = 0.01  # [m] allowed depth of a finger's axis below the table: mounts are inaccurate, and fingers press
_REACHING = ("arm", "hand")  # kinds of groups that reach the table
_BLOCK = 16  # postures per block, so that intermediate results fit the caches

_Indices = NDArray[np.intp]


class Clearance:
    """Distances of the checked `pairs`, named by parts ("left_arm/link5") or "table".

    A pair of links occurs once per pair of their capsules. Fingers reach the table on purpose: their distance to it is
    measured from the capsules' axes, which may be slightly below it (`touch_thresholds`).

    The pairs are: links of different arms, links of one body, and links with the table (plane z = 0 of the scene).
    Excluded, because they are not informative:

    * two links with at most one of the robot's joints between them (not counting grippers and joints that no group
      moves);
    * two links of arms with separate roots, if nothing moves these links;
    * pairs that touch at nearly every posture (95 %), as in a wrist, either in this arm or in the other arms that are
      equal to it;
    * the table for parts that no arm or hand moves (a torso next to it) or that only rotate about the vertical;
    * everything in collision.ignore and collision.without of robot.toml.
    """

    def __init__(self, robot: Robot) -> None:
        body = Body(robot)
        parts = [
            (part, capsule)
            for link, link_capsules in capsules(robot).items()
            for part in body.parts_showing(link)
            for capsule in link_capsules
        ]
        parts.sort(key=lambda one: one[0])
        self._body = body
        self._parts = np.array([part for part, _ in parts], dtype=np.intp)
        self._names = [body.parts[part] for part in self._parts]
        self._radii = np.array([capsule.radius for _, capsule in parts])
        self._ends = np.ones((len(parts), 4, 2))  # in the link, homogeneous
        for ends, (_, capsule) in zip(self._ends, parts, strict=True):
            ends[:3, 0], ends[:3, 1] = capsule.start, capsule.end
        moved = body.moving_mask()[self._parts][:, list(robot.gripper_dims)].any(axis=1)
        self._fingers = moved | np.array([capsule.finger for _, capsule in parts], dtype=bool)
        self._select_pairs(*_candidates(robot, body, self._parts))
        self._select_pairs(*self._telling(robot))

    def distances(self, q: Float64) -> Float64:
        """Return the distance [m] between the capsules of each of the K checked pairs, as [..., K].

        `q` [..., D] are values of the robot's vector. A distance is negative if the capsules overlap.
        """
        if q.ndim == 1:
            return self._distances(q)
        flat = q.reshape(-1, q.shape[-1])
        apart = np.empty((len(flat), len(self.pairs)))
        for start in range(0, len(flat), _BLOCK):
            apart[start : start + _BLOCK] = self._distances(flat[start : start + _BLOCK])
        return apart.reshape(*q.shape[:-1], len(self.pairs))

    def _distances(self, q: Float64) -> Float64:
        poses = self._body.poses(q)
        ends = poses[..., self._parts, :3, :] @ self._ends  # [..., N, 3, 2]
        starts = ends[..., 0]
        directions = ends[..., 1] - starts
        first, second = self._first, self._second
        apart = segment_distances(
            starts[..., first, :],
            directions[..., first, :],
            starts[..., second, :],
            directions[..., second, :],
        )
        lowest = ends[..., self._over, 2, :].min(axis=-1)
        return np.asarray(np.concatenate([apart, lowest], axis=-1) - self._thick)

    def touch_thresholds(self, margin: float) -> Float64:
        """Return the distances [K] below which pairs count as touching.

        The distance is `margin`, except for fingers and the table: fingers may be slightly below the table, so their
        threshold is negative.
        """
        least = np.full(len(self.pairs), margin)
        least[len(self._first) :][self._fingers[self._over]] = -_DIP
        return least

    def _select_pairs(self, first: _Indices, second: _Indices, over: _Indices) -> None:
        """Set the checked pairs: capsules `first` with capsules `second`, and capsules `over` with the table."""
        self._first, self._second, self._over = first, second, over
        standing = np.where(self._fingers[over], 0.0, self._radii[over])
        self._thick = np.concatenate([self._radii[first] + self._radii[second], standing])
        names = self._names
        self.pairs = (
            *((names[i], names[j]) for i, j in zip(first, second, strict=True)),
            *((names[i], TABLE) for i in over),
        )

    def _telling(self, robot: Robot) -> tuple[_Indices, _Indices, _Indices]:
        """Return the pairs that are informative, in the form of the three arguments of `_select_pairs`.

        Pairs that touch at nearly every posture are left out, as are parts whose distance to the table does not vary.
        """
        lower = np.where(np.isfinite(robot.lower), robot.lower, -np.pi)
        upper = np.where(np.isfinite(robot.upper), robot.upper, np.pi)
        apart = self.distances(np.random.default_rng(0).uniform(lower, upper, (_POSTURES, robot.dim)))
        columns: dict[tuple[str, str], list[int]] = {}
        for index, pair in enumerate(self.pairs):
            columns.setdefault(pair, []).append(index)
        touching: dict[tuple[str, ...], float] = {}
        for pair, own in columns.items():
            share = float((apart[:, own].min(axis=1) < MARGIN).mean())
            touching[_mirror_key(pair)] = max(share, touching.get(_mirror_key(pair), 0.0))
        telling = np.array([touching[_mirror_key(pair)] < _NEARLY_ALWAYS for pair in self.pairs], dtype=bool)
        for pair, own in columns.items():
            if TABLE in pair and np.ptp(apart[:, own], axis=0).max() <= _LEVEL:
                telling[own] = False
        count = len(self._first)
        return self._first[telling[:count]], self._second[telling[:count]], self._over[telling[count:]]


@lru_cache(maxsize=32)
def get_clearance(robot: Robot) -> Clearance:
    """Return the clearance of a robot, cached for all its users in a process."""
    return Clearance(robot)


def _mirror_key(pair: tuple[str, str]) -> tuple[str, ...]:
    """Return a key that is the same for corresponding pairs of links in arms that are equal.

    For a pair of links of two different arms, the key is the pair itself.
    """
    (group, _, link), (other_group, _, other_link) = (name.partition("/") for name in pair)
    return (link, other_link or other_group) if group == other_group or not other_link else pair


def _candidates(robot: Robot, body: Body, parts: _Indices) -> tuple[_Indices, _Indices, _Indices]:
    """Return the pairs of capsules that may collide, and the capsules that may reach the table.

    The result is the first and the second capsule of each pair, then the capsules for the table. Capsules of
    neighbouring parts, and pairs that the robot's [collision] ignores, are left out. `parts` is the part of each
    capsule.
    """
    moved = body.moving_mask()[parts]
    grippers = np.isin(np.arange(robot.dim), robot.gripper_dims)
    reaching = np.zeros(robot.dim, dtype=bool)
    for group in robot.groups:
        reaching[group.slice] = group.kind in _REACHING
    carried = moved[:, reaching & ~grippers].any(axis=1)
    moved = moved[:, ~grippers]
    roots = np.array([_root(body, part) for part in parts])
    between = (moved[:, None] ^ moved[None]).sum(axis=-1)
    together = roots[:, None] == roots[None]
    checked = between >= np.where(together, 2, 1)
    first, second = (side.astype(np.intp) for side in np.nonzero(np.triu(checked, 1)))
    ignored = {frozenset(pair) for pair in robot.collision.ignore}
    names = [body.parts[part] for part in parts]
    links = [name.partition("/")[2] for name in names]

    def ignoring(one: int, other: int) -> bool:
        alike = bool(together[one, other]) and frozenset((links[one], links[other])) in ignored
        return alike or frozenset((names[one], names[other])) in ignored

    pairs = [pair for pair in zip(first.tolist(), second.tolist(), strict=True) if not ignoring(*pair)]
    first, second = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    over = np.array(
        [
            index
            for index in np.flatnonzero(carried)
            if not ignored & {frozenset((links[index], TABLE)), frozenset((names[index], TABLE))}
        ],
        dtype=np.intp,
    )
    return first, second, over


def _root(body: Body, part: np.intp) -> int:
    while body.above[part] >= 0:
        part = body.above[part]
    return int(part)


def collision_problems(robot: Robot, margin: float = MARGIN) -> list[str]:
    """Return the faults of the robot's [collision] as sentences.

    A fault is a pair that touches at a named pose, or that there are no pairs at all.
    """
    clearance = Clearance(robot)
    least = dict(zip(clearance.pairs, clearance.touch_thresholds(margin).tolist(), strict=True))
    if not clearance.pairs:
        return ["collision: no two links are looked at; links need shapes, or capsules in robot.toml"]
    distances: dict[tuple[str, str, str], float] = {}
    for name, pose in robot.poses.items():
        for (first, second), apart in zip(clearance.pairs, clearance.distances(pose).tolist(), strict=True):
            distances[name, first, second] = min(apart, distances.get((name, first, second), apart))
    return [
        f"poses.{name}: {first} and {second} are {1000 * apart:.0f} mm apart, needed: {1000 * least[first, second]:g}; "
        "correct the pose or the capsules, or name the pair in collision.ignore"
        for (name, first, second), apart in distances.items()
        if apart < least[first, second]
    ]
