"""Poses of all links of a robot, in the scene and in each other's frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robots import urdf
from robots.chain import motion_table, motions
from robots.errors import RobotError
from robots.robot import Group, Robot, urdf_copies
from robots.rotations import Float64, transform_of
from robots.urdf import Joint, Urdf


class BodyTables(NamedTuple):
    """Tables from which the poses of P parts follow; row p belongs to part p and to the joint that moves it.

    The value of the joint is `coupling` . q + `offsets`, clipped to `low` and `high`. The part's transform relative to
    its parent is the sum of the four matrices `motions` [P, 4, 16], weighted by 1, by the cosine and the sine of the
    value, and by the value itself. `above` is the index of the parent, -1 for the scene; parents come first.
    """

    motions: Float64
    coupling: Float64  # [P, D], at most one non-zero number per row
    offsets: Float64
    low: Float64
    high: Float64
    above: NDArray[np.intp]


class Body:
    """Body of a robot: its `parts` and their `poses`.

    The name of a part consists of the group that moves the part and the part's link, e.g. "left_arm/link2". If the URDF
    describes one of several equal arms, there is one copy of the tree per arm; a URDF of the whole body exists once.
    `jaws` maps each group with a gripper to the indices of the gripper's finger parts. `above` [P] is the index of each
    part's parent, -1 for a root.
    """

    def __init__(self, robot: Robot) -> None:
        tree = urdf.read(robot.urdf)
        copies = [_Copy(robot, tree, groups) for groups in urdf_copies(robot.groups)]
        names = [[copy.part(link) for link in copy.links] for copy in copies]
        self.parts = tuple(name for part in names for name in part)
        starts = np.cumsum([0, *(len(part) for part in names[:-1])]).tolist()
        placed = list(zip(starts, copies, strict=True))
        self._links = [
            {link: start + index for index, link in enumerate(copy.links)} for start, copy in placed
        ]
        self._copy_of = {
            group.name: index for index, groups in enumerate(urdf_copies(robot.groups)) for group in groups
        }
        self.jaws = {
            name: tuple(start + copy.links.index(link) for link in links)
            for start, copy in placed
            for name, links in copy.fingers.items()
        }
        self._dim = robot.dim
        self._name = robot.name
        self._coupling = np.concatenate([copy.coupling for copy in copies])  # [P, D]
        self._offsets = np.concatenate([copy.offsets for copy in copies])  # [P]
        self._low, self._high = np.concatenate([copy.bounds for copy in copies], axis=1)
        self._tables = np.concatenate([copy.tables for copy in copies])  # [P, 4, 16]
        self.above = np.concatenate([copy.above_from(start) for start, copy in placed])
        self._layers = _layers(self.above)

    def part(self, name: str) -> int:
        """Return the index of the part with that name.

        Raises:
            RobotError: If it does not exist; the message lists the names.
        """
        if name not in self.parts:
            raise RobotError(f"{self._name} has no part {name!r}; it has {', '.join(self.parts)}")
        return self.parts.index(name)

    def parts_showing(self, link: str) -> tuple[int, ...]:
        """Return the indices of the parts that are copies of a URDF link; () if there is no such link."""
        return tuple(links[link] for links in self._links if link in links)

    def link_of(self, group: str, link: str) -> int:
        """Return the index of a link.

        A robot may contain several copies of the same kinematic tree, each moved by other groups. The link `link` is
        taken from the copy that `group` moves.

        Raises:
            RobotError: If it does not exist; the message lists the links.
        """
        links = self._links[self._copy_of[group]]
        if link not in links:
            raise RobotError(f"{self._name}: {group} has no link {link!r}; it has {', '.join(sorted(links))}")
        return int(links[link])

    def moving_mask(self) -> NDArray[np.bool_]:
        """Return bool [P, D]: which numbers of the robot's vector move which part, directly or by moving its parent."""
        moved: NDArray[np.bool_] = self._coupling != 0
        for parts, above in self._layers:
            moved[parts] |= moved[above]
        return moved

    @property
    def tables(self) -> BodyTables:
        """Tables from which `poses` is computed, so that other implementations can compute the poses too."""
        return BodyTables(self._tables, self._coupling, self._offsets, self._low, self._high, self.above)

    def poses(self, q: Float64) -> Float64:
        """Return the poses of the parts, scene <- part [..., P, 4, 4], for the robot's vector q [..., D].

        Raises:
            RobotError: If q has the wrong shape.
        """
        if q.shape[-1:] != (self._dim,):
            raise RobotError(
                f"{self._name}: joints of shape {q.shape} were given; allowed: [..., {self._dim}]"
            )
        values = np.clip(q @ self._coupling.T + self._offsets, self._low, self._high)
        poses = motions(values, self._tables)
        for parts, above in self._layers:
            poses[..., parts, :, :] = poses[..., above, :, :] @ poses[..., parts, :, :]
        return poses


class _Copy:
    """One copy of the tree: its links from the root outwards, and the tables that place each link relative to its
    parent.
    """

    def __init__(self, robot: Robot, tree: Urdf, groups: Sequence[Group]) -> None:
        self._tree = tree
        self._groups = groups
        joints = tree.outwards()
        self._movers = {joint.child: joint for joint in joints}
        self.links = [tree.root, *self._movers]
        self.coupling = np.zeros((len(self.links), robot.dim))
        self.offsets = np.zeros(len(self.links))
        self.bounds = np.array([[-np.inf], [np.inf]]) * np.ones(len(self.links))
        self.tables = np.zeros((len(self.links), 4, 16))
        self.tables[0, 0] = self._placement(robot).ravel()
        for index, joint in enumerate(joints, 1):
            if joint.kind == "fixed":
                self.tables[index, 0] = joint.origin.ravel()
            else:
                self.tables[index] = motion_table(joint.origin, joint)
                self._drive(index, joint)

    @property
    def fingers(self) -> dict[str, list[str]]:
        """Links that a gripper moves, by the name of the gripper's group."""
        return {
            group.name: [
                link
                for link, joint in self._movers.items()
                if self._tree.master(joint)[0].name in group.gripper.fingers
            ]
            for group in self._groups
            if group.gripper is not None
        }

    def above_from(self, start: int) -> NDArray[np.intp]:
        """Return the index of each link's parent, -1 for the root, if the first link of this copy has index `start`."""
        parents = [self.links.index(joint.parent) for joint in self._movers.values()]
        return np.array([-1, *(start + parent for parent in parents)], dtype=np.intp)

    def part(self, link: str) -> str:
        """Return the name of a link's part: a group's name, "/" and the link's name.

        The group is the one that moves the link. If no group moves the link, the first group of this copy is named.
        """
        at = link
        while at in self._movers:
            master, _, _ = self._tree.master(self._movers[at])
            for group in self._groups:
                if master.name in group.urdf_joints or (
                    group.gripper and master.name in group.gripper.fingers
                ):
                    return f"{group.name}/{link}"
            at = self._movers[at].parent
        return f"{self._groups[0].name}/{link}"

    def _placement(self, robot: Robot) -> Float64:
        """Return the transform scene <- root: the robot's stand, followed by the mount of the copy's first group."""
        return transform_of(robot.stand) @ transform_of(self._groups[0].mount)

    def _drive(self, index: int, joint: Joint) -> None:
        """Set coupling, offset and bounds of a joint; if no group moves it, its value is the pinned one or 0."""
        master, factor, offset = self._tree.master(joint)
        for group in self._groups:
            if master.name in group.urdf_joints:
                dim = group.joint_dims[group.urdf_joints.index(master.name)]
                self.coupling[index, dim] = factor
                self.offsets[index] = offset
                return
            if group.gripper is not None and master.name in group.gripper.fingers:
                gripper, ends = group.gripper, np.array(group.gripper.fingers[master.name])
                slope = (ends[1] - ends[0]) / (gripper.upper - gripper.lower)
                self.coupling[index, group.gripper_dim] = factor * slope
                self.offsets[index] = factor * (ends[0] - slope * gripper.lower) + offset
                self.bounds[:, index] = np.sort(factor * ends + offset)
                return
        pinned = {
            name: value for group in self._groups if group.chain for name, value in group.chain.pinned.items()
        }
        self.offsets[index] = factor * pinned.get(master.name, 0.0) + offset


def _layers(above: NDArray[np.intp]) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Return the parts of each layer with the indices of their parents, from the children of the roots outwards."""
    depth = np.zeros(len(above), dtype=np.intp)
    for part, parent in enumerate(above):  # parents come first
        depth[part] = 0 if parent < 0 else depth[parent] + 1
    layers = [np.flatnonzero(depth == layer) for layer in range(1, int(depth.max()) + 1)]
    return [(parts, above[parts]) for parts in layers]
