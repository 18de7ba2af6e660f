"""Robot of an episode, with the groups recorded at the time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import robots
from evaweb.core.errors import NotFound
from evaweb.stations.robot_geometry import DrawnRobot, drawn_robot, groups_of
from runtime.core.sentences import Pattern

_ROBOT_DOES_NOT_EXIST_THERE = Pattern(
    "episodes.robot.robot_does_not_exist_there",
    "robot {name!r:.80} does not exist; there are: {names}",
)
_EPISODE_HAS_JOINTS_HAS_TODAY = Pattern(
    "episodes.robot.episode_has_joints_has_today",
    "the episode has {get} joints, {name} has {dim} today",
)
_JOINTS_HAVE_OTHER_NAMES_ANOTHER = Pattern(
    "episodes.robot.joints_have_other_names_another",
    "the joints of {name} have other names, or another order, today",
)


def robot_of_manifest(manifest: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the robot entry of a manifest; {} if it has none."""
    robot = manifest.get("robot")
    return robot if isinstance(robot, Mapping) else {}


def groups_of_manifest(manifest: Mapping[str, Any]) -> tuple[str, ...] | None:
    """Return the groups of the recorded joints; None if joint names were not recorded."""
    names = robot_of_manifest(manifest).get("joint_names")
    return groups_of(map(str, names)) if isinstance(names, list) and names else None


def drawn_robot_for(manifest: Mapping[str, Any]) -> DrawnRobot:
    """Return the robot for drawing, by its present description.

    Raises: NotFound if it is not described any more, or its joints differ from the recorded ones.
    """
    drawn = drawn_robot(str(robot_of_manifest(manifest).get("name", "")), groups_of_manifest(manifest))
    _require_same(drawn.robot, manifest)
    return drawn


def robot_for(manifest: Mapping[str, Any]) -> robots.Robot:
    """Return the robot's present description, without its scene.

    Raises: NotFound if it is not described any more, or its joints differ from the recorded ones.
    """
    name, groups = str(robot_of_manifest(manifest).get("name", "")), groups_of_manifest(manifest)
    if not robots.is_described(name):
        raise NotFound(_ROBOT_DOES_NOT_EXIST_THERE(name=name, names=", ".join(robots.robot_names())))
    try:
        robot = robots.load_robot(name, groups)
    except robots.RobotError as error:
        raise NotFound(str(error)) from error
    _require_same(robot, manifest)
    return robot


def _require_same(robot: robots.Robot, manifest: Mapping[str, Any]) -> None:
    recorded = robot_of_manifest(manifest)
    if robot.dim != recorded.get("dim"):
        raise NotFound(_EPISODE_HAS_JOINTS_HAS_TODAY(get=recorded.get("dim"), name=robot.name, dim=robot.dim))
    if groups_of_manifest(manifest) is not None and list(robot.joint_names) != recorded["joint_names"]:
        raise NotFound(_JOINTS_HAVE_OTHER_NAMES_ANOTHER(name=robot.name))
