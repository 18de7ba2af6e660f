"""Pose frames that a deployment declares: the robot's mount frame, or a link of its URDF."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from robots import Body, RobotError, urdf
from robots.rotations import quaternion_of_matrix, quaternion_product, transform_of
from runtime.core.errors import ConfigurationError
from runtime.core.types import Float64

if TYPE_CHECKING:
    from robots import Group, Robot
    from robots.urdf import Urdf

_POSITION, _QUATERNION = slice(0, 3), slice(3, 7)


class Frame:
    """Declared frame for the poses of all arms of a robot; "" means the frame that each arm declares itself.

    If `name` is a link, the link is found in the copy of the URDF to which the arm belongs: each arm has its own base.
    Joints of other groups (a torso) between the link and the arm's frame have the values of the given joints.

    Raises:
        ConfigurationError: An unknown frame, or a link that is moved by an arm itself.
    """

    def __init__(self, robot: Robot, name: str, key: str) -> None:
        self._mounted = bool(name) and name == robot.mount_frame
        self.own = not name or (not self._mounted and all(arm.frame == name for arm in robot.arms))
        if self.own:
            return
        self._body = Body(robot)
        self._stand = np.linalg.inv(transform_of(robot.stand))
        tree = urdf.read(robot.urdf)
        if not self._mounted:
            for arm in robot.arms:
                _require_standing(tree, robot, arm, name, key)
            self._links = [self._body.link_of(arm.name, name) for arm in robot.arms]
        self._frames = [self._body.link_of(arm.name, str(arm.frame)) for arm in robot.arms]

    def express(self, vectors: Float64, joints: Float64) -> Float64:
        """Transform vectors [T, arms, 7 or more] from each arm's frame to this frame; joints are [T, D] or [1, D]."""
        if self.own:
            return vectors
        turn, shift = self._relation(joints)
        expressed = vectors.copy()
        expressed[..., _POSITION] = _turned(turn, vectors[..., _POSITION]) + shift
        expressed[..., _QUATERNION] = quaternion_product(
            quaternion_of_matrix(turn), vectors[..., _QUATERNION]
        )
        return expressed

    def resolve(self, vectors: Float64, joints: Float64) -> Float64:
        """Transform vectors from this frame to each arm's own frame; the inverse of `express`."""
        if self.own:
            return vectors
        turn, shift = self._relation(joints)
        back = np.swapaxes(turn, -1, -2)
        resolved = vectors.copy()
        resolved[..., _POSITION] = _turned(back, vectors[..., _POSITION] - shift)
        resolved[..., _QUATERNION] = quaternion_product(quaternion_of_matrix(back), vectors[..., _QUATERNION])
        return resolved

    def _relation(self, joints: Float64) -> tuple[Float64, Float64]:
        """Return the pose of each arm's frame in this frame: rotations [T or 1, arms, 3, 3], positions [T or 1, arms,
        3].
        """
        poses = self._body.poses(joints)
        below = poses[..., self._frames, :, :]
        if self._mounted:
            relation = self._stand @ below
        else:
            declared = poses[..., self._links, :, :]
            back = np.swapaxes(declared[..., :3, :3], -1, -2)
            turn = back @ below[..., :3, :3]
            return turn, _turned(back, below[..., :3, 3] - declared[..., :3, 3])
        return relation[..., :3, :3], relation[..., :3, 3]


def frame_names(robot: Robot) -> list[str]:
    """Return the frames that may be declared for a robot."""
    return [robot.mount_frame, *sorted(urdf.read(robot.urdf).links)]


def _require_standing(tree: Urdf, robot: Robot, arm: Group, link: str, key: str) -> None:
    """Raise ConfigurationError if `link` is unknown, or if `arm` itself moves the link.

    Poses in a frame that the arm moves would depend on the solution of the inverse kinematics. `key` names the setting
    in the message.
    """
    try:
        above = tree.between(tree.root, link)
    except RobotError:
        allowed = ", ".join(frame_names(robot))
        raise ConfigurationError(
            f"{key}.frame = {link!r} is no frame of {robot.name}; "
            f'allowed: "" for each arm\'s own, {robot.mount_frame} (what mounts are given in), or a link: {allowed}'
        ) from None
    for joint in above:
        moved = joint.mimic.joint if joint.mimic else joint.name
        if moved in arm.urdf_joints:
            raise ConfigurationError(
                f"{key}.frame = {link!r} moves with {arm.name} ({joint.name}): a pose in it would depend on the "
                "joints that are looked for; allowed: a frame that no arm moves"
            )


def _turned(rotations: Float64, vectors: Float64) -> Float64:
    return np.asarray((rotations @ vectors[..., None])[..., 0])
