"""Poses of a robot's arms on the simulated bench: their frames, end effectors and fingertips in the world."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from robots import Body, Chain, urdf
from robots.robot import copy_of
from robots.rotations import transform_of
from runtime.core.errors import SetupError
from runtime.core.types import Float64

if TYPE_CHECKING:
    from robots import Group, Robot
    from robots.urdf import Joint, Urdf


_UPRIGHT = 0.999  # least vertical part of the unit axis of an upright joint


class ArmFrames:
    """Forward kinematics of one arm: transforms [4, 4] in the world (the frame of the robot's scene) for joints q [D].

    Fixed parts are computed once, so that an arm on a fixed base costs only its own chain. `upright` is 1 if the arm's
    first joint turns it about the vertical, -1 if it does so in the opposite direction, else 0.

    Raises:
        SetupError: If the group has no end effector.
    """

    def __init__(self, robot: Robot, arm: Group) -> None:
        if arm.chain is None or arm.frame is None:
            raise SetupError(f"group {arm.name} has no end effector; allowed: an arm")
        self.arm = arm
        self._body = _body_of(robot)
        first = urdf.read(robot.urdf).joint(arm.urdf_joints[0])
        self._first = self._body.link_of(arm.name, first.child)
        self._below, self._dims = _chain_to_frame(robot, arm)
        root = transform_of(robot.stand) @ transform_of(copy_of(arm, robot.groups)[0].mount)
        still = self._body.poses(robot.poses["home"])[self._body.link_of(arm.name, arm.frame)]
        self._base: Float64 = still if self._below is None else root
        axis = self.shoulder(robot.poses["home"])[:3, :3] @ first.axis
        self.upright = round(float(axis[2])) if abs(axis[2]) > _UPRIGHT else 0

    def frame(self, q: Float64) -> Float64:
        """Return the pose of the frame that the arm declares."""
        return self._base if self._below is None else self._base @ self._below.forward(q[self._dims])

    def eef(self, q: Float64) -> Float64:
        """Return the pose of the end-effector link."""
        return np.asarray(self.frame(q) @ self.arm.transform(q))

    def tip(self, q: Float64) -> Float64:
        """Return the pose of the fingertips: z ahead, y the opening direction.

        For an arm without fingers, return the pose of the end-effector link.
        """
        return self.eef(q) if self.arm.tip is None else np.asarray(self.eef(q) @ self.arm.tip)

    def shoulder(self, q: Float64) -> Float64:
        """Return the pose of the link that the arm's first joint moves."""
        return np.asarray(self._body.poses(q)[self._first])


@lru_cache(maxsize=32)  # cache: reads the description of a robot, which does not change
def arm_frames(robot: Robot) -> Mapping[str, ArmFrames]:
    """Return the frames of the robot's arms by name."""
    return MappingProxyType({arm.name: ArmFrames(robot, arm) for arm in robot.arms})


@lru_cache(maxsize=32)  # cache: reads the description of a robot, which does not change
def _body_of(robot: Robot) -> Body:
    return Body(robot)


def _chain_to_frame(robot: Robot, arm: Group) -> tuple[Chain | None, list[int]]:
    """Return the chain from the root to an arm's frame, and the dimensions of its joints; None and [] if it is
    fixed.
    """
    tree, members = urdf.read(robot.urdf), copy_of(arm, robot.groups)
    movers = {
        name: int(dim)
        for group in members
        for name, dim in zip(group.urdf_joints, group.joint_dims, strict=True)
    }
    assert arm.frame is not None
    leaders = [_leader(tree, joint) for joint in tree.between(tree.root, arm.frame) if joint.kind != "fixed"]
    driven = [name for name in dict.fromkeys(leaders) if name in movers]
    if not driven:
        return None, []
    pinned_values = {
        name: value for group in members if group.chain for name, value in group.chain.pinned.items()
    }
    pinned = {name: pinned_values.get(name, 0.0) for name in leaders if name not in movers}
    return Chain(tree, tree.root, arm.frame, driven, pinned), [movers[name] for name in driven]


def _leader(tree: Urdf, joint: Joint) -> str:
    """Return the name of the joint that a mimic joint finally follows; the name of `joint` itself if it is no mimic
    joint.
    """
    while joint.mimic is not None:
        joint = tree.joint(joint.mimic.joint)
    return joint.name
