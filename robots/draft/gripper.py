"""Draft of the gripper of an arm, derived from the URDF.

The draft has the joint that drives the gripper, which of its ends is open, how far the fingers part, and the frame
between the fingertips.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from robots.draft.geometry import places
from robots.draft.group_guessing import GroupGuess
from robots.limits import FASTEST
from robots.rotations import Float64, quaternion_of_matrix
from robots.urdf import Joint, Urdf

_SLIDE, _TURN = 0.04, 1.0  # [m], [rad] travel of a finger for which the URDF gives none
_SECONDS = 0.5  # [s] for the whole travel if the URDF gives no speed
_PAD = 0.01  # [m] from the end of a finger's shapes to its contact
_TINY = 1e-6
_GRASPS = ("tcp", "grasp", "center", "centre", "eef", "ee_link")
_PREFERRED = (*_GRASPS, "tool0", "ee", "tip", "flange", "hand")


@dataclass(frozen=True, slots=True)
class GripperDraft:
    """Suggested gripper, whose value in messages is the position of the joint `driver`.

    `fingers` has two values for each finger joint: the first when the gripper is at `lower`, the second when it is at
    `upper`. `apart` is the distance [m] by which the fingers part from `close` to `open`, None if they do not. `tip`
    [7] is the pose of the frame between the fingertips, in the frame of the end effector. `placeholder_notes` are
    sentences about placeholders.
    """

    driver: str
    unit: str
    lower: float
    upper: float
    open: float
    close: float
    velocity: float
    fingers: Mapping[str, tuple[float, float]]
    apart: float | None
    tip: Float64
    placeholder_notes: tuple[str, ...]


def end_link(tree: Urdf, limb: GroupGuess) -> str:
    """Return the end effector of an arm.

    Candidates are the link that the last joint moves and the links that are fixed to it. For an arm with fingers it is
    a candidate that is named like a frame for grasping, else the link that carries the fingers. For an arm without
    fingers it is a candidate without children and with a typical name, else the link that the last joint moves.
    """
    last = tree.joint(limb.joints[-1]).child
    if limb.fingers:
        return _hand(tree, limb, last)
    leaves = [link for link in _behind(tree, last, rigid=True) if not tree.children(link)]
    return next((link for word in _PREFERRED for link in leaves if word in link.lower()), last)


def _hand(tree: Urdf, limb: GroupGuess, last: str) -> str:
    """Return a link after the last joint that is named like a frame for grasping, else the link that carries the
    fingers.
    """
    rigid = _behind(tree, last, rigid=True)
    named = (link for word in _GRASPS for link in rigid if word in link.lower())
    return next(named, tree.joint(limb.fingers[0]).parent)


def guess_gripper(
    tree: Urdf, limb: GroupGuess, eef_link: str, corners: Mapping[str, Float64]
) -> GripperDraft:
    """Return the suggested gripper of an arm with fingers.

    `corners` has the corners [n, 3] of the shapes of each link, for the links that have real shapes.
    """
    followed = tree.masters()
    driver = tree.joint(
        max(limb.fingers, key=lambda name: (name in followed, tree.joint(name).kind == "prismatic"))
    )
    doubts: list[str] = []
    lower, upper = _range(driver, doubts)
    jaws = _Jaws(tree, limb, eef_link, corners)
    fingers = jaws.closing_values(driver.name, (lower, upper), _independent_fingers(tree, limb, driver.name))
    opening, closed, open_at = jaws.opening(fingers, lower, upper)
    if opening is None:
        doubts.append("which end is open cannot be read off the URDF")
    return GripperDraft(
        driver=driver.name,
        unit="m" if driver.kind == "prismatic" else "rad",
        lower=lower,
        upper=upper,
        open=open_at,
        close=lower if open_at == upper else upper,
        velocity=_velocity(driver, upper - lower, doubts),
        fingers=fingers,
        apart=opening,
        tip=jaws.tip(closed, named=any(word in eef_link.lower() for word in _GRASPS)),
        placeholder_notes=tuple(doubts),
    )


def _range(joint: Joint, doubts: list[str]) -> tuple[float, float]:
    lower, upper = joint.lower, joint.upper
    if lower is not None and upper is not None and np.isfinite([lower, upper]).all() and lower < upper:
        return lower, upper
    doubts.append(f"the URDF gives {joint.name} no range: lower and upper are placeholders")
    return 0.0, _SLIDE if joint.kind == "prismatic" else _TURN


def _velocity(joint: Joint, travel: float, doubts: list[str]) -> float:
    if joint.velocity is not None and 0 < joint.velocity <= FASTEST:
        return joint.velocity
    value = "no velocity" if joint.velocity is None else f"{joint.velocity:g}/s"
    doubts.append(f"the URDF gives {joint.name} {value}: the whole way in {_SECONDS:g} s is a placeholder")
    return round(travel / _SECONDS, 4)


def _independent_fingers(tree: Urdf, limb: GroupGuess, driver: str) -> dict[str, tuple[float, float]]:
    """Return the limits by name of the finger joints that have limits and move independently of the driver."""
    joints = [tree.joint(name) for name in limb.fingers if name != driver]
    return {joint.name: _range(joint, []) for joint in joints if joint.kind != "continuous"}


class _Jaws:
    """Fingers of a gripper as branches of the tree, each with a point near its end, in the end effector's frame."""

    def __init__(self, tree: Urdf, limb: GroupGuess, eef_link: str, corners: Mapping[str, Float64]) -> None:
        self._tree = tree
        self._eef = eef_link
        self._corners = corners
        moving = [
            joint
            for joint in tree.outwards()
            if joint.kind != "fixed" and tree.master(joint)[0].name in limb.fingers
        ]
        self._hand = moving[0].parent
        self._branches: list[list[str]] = []
        for joint in moving:
            if not any(joint.child in branch for branch in self._branches):
                self._branches.append(_behind(tree, joint.child))
        self._pairs = list(combinations(range(len(self._branches)), 2)) or [(0, -1)]  # -1: the hand
        half = {name: sum(_range(tree.joint(name), [])) / 2 for name in limb.fingers}
        at = self._in_eef(half)
        self._z = self._pointing(at)
        self._ends = [self._end(branch, at) for branch in self._branches]

    def closing_values(
        self, driver: str, ends: tuple[float, float], others: Mapping[str, tuple[float, float]]
    ) -> dict[str, tuple[float, float]]:
        """Return the values of every finger joint when the driver is at its lower and at its upper limit.

        A URDF does not say in which direction the other fingers move when the driver moves. The directions are chosen
        with which the fingers part most.

        Args:
            driver: Joint whose position is the gripper's value.
            ends: Lower and upper limit of the driver.
            others: Lower and upper limit of each finger joint that moves independently of the driver.
        """
        choices = [
            {driver: ends} | dict(zip(others, turned, strict=True))
            for turned in product(*((limits, limits[::-1]) for limits in others.values()))
        ]
        return max(choices, key=lambda fingers: max(self._partings(fingers)))

    def opening(
        self, fingers: Mapping[str, tuple[float, float]], lower: float, upper: float
    ) -> tuple[float | None, dict[str, float], float]:
        """Return how far the fingers part [m], the joints' values when closed, and the driver's value when open.

        The distance is None if the fingers do not part. `fingers` has for each joint its values at the two limits of
        the driver. `lower` and `upper` are the driver's limits.
        """
        partings = self._partings(fingers)
        pair = self._pairs[int(np.argmax(partings))]
        at_lower, at_upper = ({name: ends[end] for name, ends in fingers.items()} for end in (0, 1))
        if max(partings) < _TINY:
            return None, at_lower, upper
        gaps = [float(np.linalg.norm(self._between(pair, values))) for values in (at_lower, at_upper)]
        if len(self._branches) == 1:  # against a fixed jaw: it opens away from zero
            gaps = [abs(lower), abs(upper)]
        opened = round(max(partings), 4)
        return (opened, at_upper, lower) if gaps[0] > gaps[1] else (opened, at_lower, upper)

    def tip(self, closed: Mapping[str, float], *, named: bool) -> Float64:
        """Return the frame [7] between the fingertips in the end effector: z ahead, y in the opening direction.

        The position of the frame comes from the shapes of the fingers. Without shapes there are two cases. If `named`,
        which means that the end effector's name is that of a frame for grasping, the position is the origin of the end
        effector. Otherwise the position is midway between the ends of the fingers. `closed` has the values of the
        joints when the gripper is closed.
        """
        at = self._in_eef(closed)
        points = [self._point(index, at) for index in range(len(self._ends))]
        far = max(float(point @ self._z) for point in points)
        middle = np.mean([point for point in points if point @ self._z > far - 2 * _PAD], axis=0)
        y = self._opens_along(closed)
        y = y - self._z * (y @ self._z)
        y = np.roll(self._z, 1) if np.linalg.norm(y) < _TINY else y / np.linalg.norm(y)
        frame = np.column_stack([np.cross(y, self._z), y, self._z])
        reach = self._reach(at)
        if reach is None and named:
            middle = np.zeros(3)
        elif reach is not None:
            middle = middle + self._z * (reach - _PAD - middle @ self._z)
        return np.concatenate([middle, quaternion_of_matrix(frame)])

    def _pointing(self, at: Mapping[str, Float64]) -> Float64:
        """Return the axis of the end effector along which the fingers extend from the hand."""
        hand = at[self._hand][:3, 3]
        reaching = [
            max(
                (self._centre(link, at) - hand for link in branch), key=lambda way: float(np.linalg.norm(way))
            )
            for branch in self._branches
        ]
        return _along(np.mean(reaching, axis=0))

    def _end(self, branch: list[str], at: Mapping[str, Float64]) -> tuple[str, Float64]:
        """Return the link of a branch that extends farthest, and the centre of that link's far end in its own frame."""
        points = {link: self._points_in_eef(link, at) for link in branch}
        link = max(branch, key=lambda name: float((points[name] @ self._z).max()))
        along = points[link] @ self._z
        near, far = along.min(), along.max()
        end = points[link][along >= far - 0.3 * (far - near)].mean(axis=0)
        return link, np.linalg.inv(at[link]) @ np.append(end, 1.0)

    def _partings(self, fingers: Mapping[str, tuple[float, float]]) -> list[float]:
        """Return the distance [m] by which each pair of finger branches moves apart between the two limits.

        `fingers` has for each finger joint its values at the lower and at the upper limit of the gripper.
        """
        at_lower, at_upper = ({name: ends[end] for name, ends in fingers.items()} for end in (0, 1))
        displacements = [
            self._between(pair, at_upper) - self._between(pair, at_lower) for pair in self._pairs
        ]
        return [float(np.linalg.norm(displacement)) for displacement in displacements]

    def _opens_along(self, closed: Mapping[str, float]) -> Float64:
        """Return the direction in the end effector in which the fingers begin to part when they open."""
        step = {name: value + 1e-3 for name, value in closed.items()}
        displacements = [self._between(pair, step) - self._between(pair, closed) for pair in self._pairs]
        return max(displacements, key=lambda way: float(np.linalg.norm(way)))

    def _between(self, pair: tuple[int, int], values: Mapping[str, float]) -> Float64:
        at = self._in_eef(values)
        first, second = (self._point(index, at) if index >= 0 else np.zeros(3) for index in pair)
        return np.asarray(first - second)

    def _point(self, index: int, at: Mapping[str, Float64]) -> Float64:
        link, end = self._ends[index]
        return np.asarray((at[link] @ end)[:3])

    def _in_eef(self, values: Mapping[str, float]) -> dict[str, Float64]:
        at = places(self._tree, values)
        back = np.linalg.inv(at[self._eef])
        return {link: back @ place for link, place in at.items()}

    def _points_in_eef(self, link: str, at: Mapping[str, Float64]) -> Float64:
        """Return the corners [n, 3] of a link's shapes in the end effector's frame, or the link's origin if it has
        none.
        """
        shapes = self._corners.get(link, np.zeros((1, 3)))
        return np.asarray(shapes @ at[link][:3, :3].T + at[link][:3, 3])

    def _centre(self, link: str, at: Mapping[str, Float64]) -> Float64:
        points = self._points_in_eef(link, at)
        return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)

    def _reach(self, at: Mapping[str, Float64]) -> float | None:
        """Return how far the fingers' shapes extend along z, None if there are no shapes."""
        visible = [link for branch in self._branches for link in branch if link in self._corners]
        return max((float((self._points_in_eef(link, at) @ self._z).max()) for link in visible), default=None)


def _behind(tree: Urdf, link: str, *, rigid: bool = False) -> list[str]:
    """Return the link and all its descendants, from it outwards; with `rigid` only those that are fixed to it."""
    links = [link]
    for parent in links:  # the list grows during the loop
        links += [joint.child for joint in tree.children(parent) if not rigid or joint.kind == "fixed"]
    return links


def _along(direction: Float64) -> Float64:
    """Return the signed axis that is closest to the direction; z for a zero vector."""
    axis = np.zeros(3)
    index = int(np.abs(direction).argmax()) if np.abs(direction).max() > _TINY else 2
    axis[index] = -1.0 if direction[index] < 0 else 1.0
    return axis
