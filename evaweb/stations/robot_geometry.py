"""A robot as pages know it: names of its numbers, where its parts are for given joints, and in which groups."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

import robots
from evaweb.errors import NotFound
from robots.units import units_of
from runtime.core.sentences import Pattern
from runtime.kinematics.links import LinkPoses

log = logging.getLogger(__name__)
_ROBOT_DOES_NOT_EXIST_THERE = Pattern(
    "stations.robot_geometry.robot_does_not_exist_there",
    "robot {robot!r:.80} does not exist; there are: {names}",
)
_KEPT = 64  # robots in the groups of some station or episode
_kernels = ThreadPoolExecutor(1, "links")


class DrawnRobot:
    """A robot as it is drawn: its description and its scene.

    Kernels are compiled, or loaded from disk, in a thread of their own: no caller waits for them, and one before they
    are there is answered by numpy.
    """

    def __init__(self, robot: robots.Robot, scene: robots.RobotScene) -> None:
        self.robot = robot
        self.scene = scene
        self._links = _kernels.submit(LinkPoses, scene)
        self._links.add_done_callback(_compiled)

    def poses(self, q: NDArray[Any]) -> NDArray[np.float32]:
        """World <- part for joints [..., D] as float32 [..., P, 16], each matrix column by column.

        Where a joint is not a number nothing is: all of its row is NaN.
        """
        joints = np.asarray(q, np.float64)
        found = self._links.result().poses(joints) if self.compiled else self._placed(joints)
        found[~np.isfinite(joints).all(axis=-1)] = np.nan
        return found

    def _placed(self, joints: NDArray[np.float64]) -> NDArray[np.float32]:
        found = np.swapaxes(self.scene.poses(joints), -1, -2)
        return found.reshape(*found.shape[:-2], 16).astype(np.float32)

    @property
    def compiled(self) -> bool:
        """True if the kernels are there."""
        return self._links.done() and self._links.exception() is None

    def fingertip_positions(self, links: NDArray[np.float32]) -> NDArray[np.float32]:
        """Fingertips for parts at `links` [..., P, 16]: float32 [..., arms, 3], in the world [m]."""
        found = np.empty((*links.shape[:-2], len(self.robot.arms), 3), np.float32)
        for index, arm in enumerate(self.robot.arms):
            part = links[..., self.tip_part(arm), :].reshape(*links.shape[:-2], 4, 4)  # its columns as rows
            found[..., index, :] = (tip_of(arm)[:, 3] @ part)[..., :3]
        return found

    def tip_part(self, arm: robots.Group) -> int:
        """The part that is an arm's end effector, and carries its fingertips."""
        assert arm.eef_link is not None
        return self.scene.link_of(arm.name, arm.eef_link)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """The unit of every number of the robot's vector."""
        return units_of(self.robot)

    def facts(self) -> dict[str, Any]:
        """Groups, names and units of the numbers, which are grippers, names of the cameras, and the robot's title."""
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
    """The frame [4, 4] between an arm's fingertips in its end effector; without a gripper the end effector itself."""
    return np.eye(4) if arm.tip is None else arm.tip


def drawn_robot(robot: str, groups: Sequence[str] | None = None) -> DrawnRobot:
    """The looks of a known robot with these groups, None for all that are not optional.

    NotFound lists what there is, or says what its description lacks.
    """
    return _looks(robot, None if groups is None else tuple(groups))


@lru_cache(_KEPT)
def _looks(robot: str, groups: tuple[str, ...] | None) -> DrawnRobot:
    if robot not in robots.robot_names():  # a name, never a path: it may come from an address
        raise NotFound(_ROBOT_DOES_NOT_EXIST_THERE(robot=robot, names=", ".join(robots.robot_names())))
    try:
        described = robots.load_robot(robot, groups)
        return DrawnRobot(described, robots.scene_of(described))
    except robots.RobotError as error:
        raise NotFound(str(error)) from error


def groups_of(joint_names: Iterable[str]) -> tuple[str, ...]:
    """The groups that numbers of these names ("group.joint") are in, in their order."""
    return tuple(dict.fromkeys(name.partition(".")[0] for name in joint_names))


def describe_robot(robot: str) -> dict[str, Any]:
    """The facts of a robot; where its description cannot be read, none but why: stopping must work all the same."""
    try:
        return drawn_robot(robot).facts()
    except NotFound as error:
        nothing: dict[str, Any] = {
            key: [] for key in ("groups", "joint_names", "units", "gripper_dims", "cameras")
        }
        return {"robot": robot, "title": robot, **nothing, "error": str(error)}
