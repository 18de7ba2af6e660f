"""Home and ready poses for a robot of which only the URDF is known, in which it touches neither itself nor the
table.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robots.body import Body
from robots.clearance import MARGIN, Clearance
from robots.draft.geometry import places
from robots.robot import Group, Robot
from robots.rotations import Float64
from robots.urdf import Urdf

CLEAR = 0.01  # [m] distance between links that a posture must have
_INSIDE = 0.05  # margin to the ends of a joint's range, as a share of it
_SAMPLES, _FEW, _ELITE, _ROUNDS = 256, 64, 24, 14  # parameters of the cross-entropy search
_LOWEST = 0.05  # [m] least height of fingertips over the table
_NONE: Float64 = np.empty(0)
_STARTS = 4  # restarts of a search
_WAY = 24  # points between home and ready
_LOOKED_AT = np.array([0.3, 0.6, 1.0])  # shares of the path that are checked during the search
_HEIGHT, _AHEAD, _ASIDE = (
    0.2,
    0.15,
    0.33,
)  # [m] target of the fingertips: beside the work area and the cameras' view
_NEAR, _ALIKE = 0.02, 1e-3  # [m], cosine: tolerances for two arms that mirror each other


def rest_posture(lower: Float64, upper: Float64) -> Float64:
    """Return zero, or the nearest value whose distance to both limits is at least a twentieth of the range."""
    return np.clip(np.zeros_like(lower), *_inner_range(lower, upper))


def _inner_range(lower: Float64, upper: Float64) -> tuple[Float64, Float64]:
    inside = _INSIDE * (upper - lower)
    return lower + inside, upper - inside


class PostureSearch:
    """Search for postures of the robot's arms; all other groups, and grippers, stay at their home values."""

    def __init__(self, robot: Robot, tree: Urdf) -> None:
        self._robot = robot
        self._tree = tree
        self._body = Body(robot)
        self._clearance = Clearance(robot)
        self._looked_at = np.ones(len(self._clearance.pairs), dtype=bool)
        self._arms = robot.arms
        pairs = ((arm.name, self._mirroring(self._arms[0], arm)) for arm in self._arms[1:])
        self._signs = {name: signs for name, signs in pairs if signs is not None}
        self._low, self._high = _inner_range(robot.lower, robot.upper)
        self._draw = np.random.default_rng(0)  # fixed seed: the same URDF gives the same draft

    def home(self) -> Float64:
        """Return the home pose or, if links touch in it, a posture near it in which as few pairs as possible touch.

        Of several such postures that were found, it is the one nearest to the home pose. Mirrored arms have mirrored
        postures.
        """
        home = self._robot.poses["home"]
        dims = self._dims()
        best, fewest = home, int(self._touching(home))
        for reach in np.linspace(0.1, 1.0, 10):
            if not fewest or not len(dims):
                break
            tried = np.tile(home, (_SAMPLES, 1))
            aims = self._draw.uniform(self._low[dims], self._high[dims], (_SAMPLES, len(dims)))
            tried[:, dims] = (home[dims] + reach * (aims - home[dims])).round(3)
            for arm in self._arms:
                tried = self._mirrored(arm, tried)
            counts = self._touching(tried)
            if counts.min() < fewest:
                fewest = int(counts.min())
                best_ones = tried[counts == fewest]
                best = best_ones[np.abs(best_ones - home).max(axis=1).argmin()]
        best = self._plain(best, home, fewest)
        self._looked_at &= (
            self._clearance.distances(best) >= MARGIN
        )  # pairs that always touch cannot distinguish postures
        return best

    def _plain(self, q: Float64, home: Float64, fewest: int) -> Float64:
        """Return the posture with as many joints as possible moved back to their home values.

        The joints are tried one after the other. A joint keeps its home value if at most `fewest` links touch each
        other with it.
        """
        for dim in self._dims():
            tried = q.copy()
            tried[dim] = home[dim]
            for arm in self._arms:
                tried = self._mirrored(arm, tried)
            if self._touching(tried) <= fewest:
                q = tried
        return q

    def ready(self, home: Float64) -> Float64:
        """Return a posture with every arm over its side of the table, fingers down; an arm that cannot reach it is at
        home.
        """
        ready = home.copy()
        for arm in self._arms:
            posture = self._mirrored(arm, ready)
            if posture is ready or not self._clear_way(home, posture):
                posture = self._search(arm, ready, home)
            ready = posture
        return ready

    def touching(self, poses: dict[str, Float64]) -> tuple[tuple[str, str], ...]:
        """Return the pairs of links that touch at one of these poses."""
        pairs = {
            pair
            for q in poses.values()
            for pair, apart in zip(self._clearance.pairs, self._clearance.distances(q), strict=True)
            if apart < MARGIN
        }
        return tuple(sorted(pairs))

    def _touching(self, q: Float64) -> NDArray[np.intp]:
        """Return how many pairs are too close plus how many arms are too low, for postures [..., D]."""
        near = (self._clearance.distances(q) < CLEAR).sum(axis=-1)
        return np.asarray(near + (self._heights(q) < _LOWEST).sum(axis=-1))

    def _heights(self, q: Float64) -> Float64:
        """Return the heights of the fingertips over the table [..., arms].

        They are computed separately, because fingertips and table are not among the checked pairs.
        """
        return (
            np.stack([self._tips(arm, q)[..., 2, 3] for arm in self._arms], axis=-1) if self._arms else _NONE
        )

    def _apart(self, q: Float64) -> Float64:
        """Return the smallest distance [...] of the checked pairs."""
        return np.asarray(self._clearance.distances(q)[..., self._looked_at].min(axis=-1, initial=np.inf))

    def _dims(self) -> NDArray[np.intp]:
        arms = [arm.joint_dims for arm in self._arms]
        return np.concatenate(arms) if arms else np.empty(0, dtype=np.intp)

    def _clear_way(self, home: Float64, ready: Float64) -> bool:
        path = home + np.linspace(0.0, 1.0, _WAY)[:, None] * (ready - home)
        high = self._heights(path).min(axis=0) >= np.minimum(_LOWEST, self._heights(home))
        return bool(self._apart(path).min() >= min(MARGIN, float(self._apart(home))) and high.all())

    def _search(self, arm: Group, start: Float64, home: Float64) -> Float64:
        """Return the best posture found for one arm, with a straight path from home that is clear of collisions.

        Cross-entropy method: sample postures, keep the best, sample around them. The search is repeated from another
        random centre until the path to its best posture is clear; return `start` if no search succeeds.
        """
        for _ in range(_STARTS):
            best = self._refined(arm, start, home)
            if self._clear_way(home, best):
                return best
        return start

    def _refined(self, arm: Group, start: Float64, home: Float64) -> Float64:
        dims = arm.joint_dims
        low, high = self._low[dims], self._high[dims]
        middle, spread = self._draw.uniform(low, high), (high - low) / 2
        best, least = start, np.inf
        for _ in range(_ROUNDS):
            tried = np.tile(start, (_SAMPLES, 1))
            drawn = middle + spread * self._draw.standard_normal((_SAMPLES, len(dims)))
            tried[:, dims] = np.clip(drawn, low, high)
            costs = self._costs(arm, tried, home)
            few = np.argsort(costs)[:_FEW]
            tried, costs = tried[few], costs[few] + self._obstacles(tried[few], home)
            order = np.argsort(costs)[:_ELITE]
            middle = tried[order][:, dims].mean(axis=0)
            spread = tried[order][:, dims].std(axis=0) + 1e-3
            if costs[order[0]] < least:
                best, least = tried[order[0]], float(costs[order[0]])
        return np.asarray(best.round(3))

    def _costs(self, arm: Group, q: Float64, home: Float64) -> Float64:
        """Return the cost of postures.

        It depends on position and direction of the fingertips, on joints near limits, and on the distance from home.
        """
        at = self._tips(arm, q)
        target = np.array([self._side(arm) * _ASIDE, _AHEAD, _HEIGHT])
        away = np.linalg.norm(at[:, :3, 3] - target, axis=-1) / 0.1
        upright = 1 + at[:, 2, 2]  # 0 if the fingers point straight down
        dims = arm.joint_dims
        ranges = self._robot.upper[dims] - self._robot.lower[dims]
        room = np.minimum(q[:, dims] - self._robot.lower[dims], self._robot.upper[dims] - q[:, dims]) / ranges
        tight = np.maximum(0.15 - room, 0.0).sum(axis=-1)
        turned = np.abs(q[:, dims] - home[dims]).mean(axis=-1)
        return np.asarray(away + 4 * upright + 4 * tight + turned)

    def _obstacles(self, q: Float64, home: Float64) -> Float64:
        """Return the cost of collisions and of low fingertips, at postures and on the straight path to them.

        It is proportional to the worst depth on the path.
        """
        path = home + _LOOKED_AT[:, None, None] * (q - home)
        deep = np.maximum(2 * CLEAR - self._apart(path), 0.0) + np.maximum(
            _LOWEST - self._heights(path), 0.0
        ).sum(axis=-1)
        return np.asarray(20 * deep.max(axis=0) / CLEAR)

    def _tips(self, arm: Group, q: Float64) -> Float64:
        end = self._body.poses(q)[..., self._body.link_of(arm.name, str(arm.eef_link)), :, :]
        return end if arm.tip is None else end @ arm.tip

    def _side(self, arm: Group) -> float:
        """Return -1 for an arm that begins on the left side of the scene or in its middle, 1 for the right side."""
        child = self._tree.joint(arm.urdf_joints[0]).child
        x = float(self._body.poses(self._robot.poses["home"])[self._body.link_of(arm.name, child), 0, 3])
        return 1.0 if x > _NEAR else -1.0

    def _mirrored(self, arm: Group, q: Float64) -> Float64:
        """Return the postures `q` [..., D] with the joints of `arm` set to the mirror image of the first arm.

        The joints of `arm` are kept within its limits. The postures are returned unchanged if the two arms are not
        mirror images of each other.
        """
        if arm.name not in self._signs:
            return q
        mirrored, dims = q.copy(), arm.joint_dims
        mirror = self._signs[arm.name] * q[..., self._arms[0].joint_dims]
        mirrored[..., dims] = np.clip(mirror, self._robot.lower[dims], self._robot.upper[dims])
        return mirrored

    def _mirroring(self, first: Group, second: Group) -> Float64 | None:
        """Return for each joint the factor, 1 or -1, by which the values of `first` become those of `second` mirrored
        in y.

        None if the arms are not mirror images of each other.
        """
        if len(first.urdf_joints) != len(second.urdf_joints):
            return None
        at = places(self._tree, {})
        signs = []
        for left, right in zip(first.urdf_joints, second.urdf_joints, strict=True):
            joints = (self._tree.joint(left), self._tree.joint(right))
            if joints[0].kind != joints[1].kind and "prismatic" in (joints[0].kind, joints[1].kind):
                return None
            left_frame, right_frame = (at[joint.child] for joint in joints)
            axes = [at[joint.child][:3, :3] @ joint.axis for joint in joints]
            slides = joints[0].kind == "prismatic"
            axis = axes[0] * (
                [1, -1, 1] if slides else [-1, 1, -1]
            )  # a rotation axis is mirrored in the other direction
            off = right_frame[:3, 3] - left_frame[:3, 3] * [1, -1, 1]
            off = (
                off if slides else off - axis * (off @ axis)
            )  # the position of a rotation joint along its axis is irrelevant
            cosine = float(axis @ axes[1])
            if abs(abs(cosine) - 1) > _ALIKE or np.abs(off).max() > _NEAR:
                return None
            signs.append(np.sign(cosine))
        return np.array(signs)
