"""Robots as pages draw them: names of the joint vector, poses of the parts for given joints, groups."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

import robots
from evaweb.core.errors import NotFound
from robots.units import units_of
from runtime.core.sentences import Pattern
from runtime.kinematics.links import LinkPoses

log = logging.getLogger(__name__)
_ROBOT_DOES_NOT_EXIST_THERE = Pattern(
    "stations.robot_geometry.robot_does_not_exist_there",
    "robot {robot!r:.80} does not exist; there are: {names}",
)
_KEPT = 64  # cached combinations of robot and groups
_kernels = ThreadPoolExecutor(1, "links")


class DrawnRobot:
    """A robot for drawing: its description and its scene.

    Kernels are compiled, or loaded from disk, in a separate thread: no caller waits for them, and until they are ready
    numpy computes the poses.
    """

    def __init__(self, robot: robots.Robot, scene: robots.RobotScene) -> None:
        self.robot = robot
        self.scene = scene
        self._links = _kernels.submit(LinkPoses, scene)
        self._links.add_done_callback(_compiled)

    def poses(self, q: NDArray[Any]) -> NDArray[np.float32]:
        """Return the transform from each part to the world for joints [..., D].

        It is float32 [..., P, 16], each matrix in column-major order. If any joint of a row is not finite, the whole
        row is NaN.
        """
        joints = np.asarray(q, np.float64)
        matrices = self._links.result().poses(joints) if self.compiled else self._placed(joints)
        matrices[~np.isfinite(joints).all(axis=-1)] = np.nan
        return matrices

    def _placed(self, joints: NDArray[np.float64]) -> NDArray[np.float32]:
        matrices = np.swapaxes(self.scene.poses(joints), -1, -2)
        return matrices.reshape(*matrices.shape[:-2], 16).astype(np.float32)

    @property
    def compiled(self) -> bool:
        """Whether the kernels are ready."""
        return self._links.done() and self._links.exception() is None

    def fingertip_positions(self, links: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the fingertips for part poses `links` [..., P, 16]: float32 [..., arms, 3] in the world [m]."""
        positions = np.empty((*links.shape[:-2], len(self.robot.arms), 3), np.float32)
        for index, arm in enumerate(self.robot.arms):
            part = links[..., self.tip_part(arm), :].reshape(
                *links.shape[:-2], 4, 4
            )  # column-major, so this is the transpose
            positions[..., index, :] = (tip_of(arm)[:, 3] @ part)[..., :3]
        return positions

    def tip_part(self, arm: robots.Group) -> int:
        """Return the index of the part that is the arm's end effector and carries its fingertips."""
        assert arm.eef_link is not None
        return self.scene.link_of(arm.name, arm.eef_link)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Unit of every element of the joint vector."""
        return units_of(self.robot)

    def facts(self) -> dict[str, Any]:
        """Return title, groups, names and units of the joint vector, gripper dimensions, cameras and rate as JSON."""
        return {
            "robot": self.robot.name,
            "title": self.robot.title,
            "groups": [group.name for group in self.robot.groups],
            "joint_names": list(self.robot.joint_names),
            "units": list(self.units),
            "gripper_dims": list(self.robot.gripper_dims),
            "cameras": [camera.key for camera in self.robot.cameras],
            "rate": self.robot.control_rate,
        }


def _compiled(links: Future[LinkPoses]) -> None:
    if (error := links.exception()) is not None:
        log.error("links are placed by numpy, thirty times slower: %s", error)


def tip_of(arm: robots.Group) -> NDArray[np.float64]:
    """Return the pose [4, 4] of the point between the fingertips in the frame of the arm's end effector.

    It is the identity without a gripper.
    """
    return np.eye(4) if arm.tip is None else arm.tip


def drawn_robot(robot: str, groups: Sequence[str] | None = None) -> DrawnRobot:
    """Return a robot with these groups; None means all that are not optional. Cached.

    Raises: NotFound, which lists the robots or states the error in the description.
    """
    return _drawn_robot(robot, None if groups is None else tuple(groups))


@lru_cache(_KEPT)
def _drawn_robot(robot: str, groups: tuple[str, ...] | None) -> DrawnRobot:
    if not robots.is_described(robot):  # the name may come from a URL: never use it as a path
        raise NotFound(_ROBOT_DOES_NOT_EXIST_THERE(robot=robot, names=", ".join(robots.robot_names())))
    try:
        described = robots.load_robot(robot, groups)
        return DrawnRobot(described, robots.scene_of(described))
    except robots.RobotError as error:
        raise NotFound(str(error)) from error


def groups_of(joint_names: Iterable[str]) -> tuple[str, ...]:
    """Return the groups of these joint names ("group.joint"), in order."""
    return tuple(dict.fromkeys(name.partition(".")[0] for name in joint_names))


def describe_robot(robot: str) -> dict[str, Any]:
    """Return the facts of a robot; if its description is unreadable, the facts are empty, and key "error" has the
    reason.

    The page must open nevertheless, because it has the stop buttons.
    """
    try:
        return drawn_robot(robot).facts()
    except NotFound as error:
        nothing: dict[str, Any] = {
            key: [] for key in ("groups", "joint_names", "units", "gripper_dims", "cameras")
        }
        return {"robot": robot, "title": robot, **nothing, "error": str(error)}
