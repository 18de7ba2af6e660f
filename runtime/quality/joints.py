"""The robot's numbers as checks need them: groups, grippers, limits, where the description is there to tell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

import robots
from robots import RobotError
from runtime.quality.block import JointSpecs

GRIPPER = "gripper"  # what such a number is called where no description says so
_UNKNOWN = np.nan


def known_joints(robot: str, names: Sequence[str]) -> JointSpecs:
    """The numbers of a robot that is described here; RobotError where it is not, or its numbers have other names."""
    described = robots.load_robot(robot, groups_of(names))
    if list(described.joint_names) != list(names):
        raise RobotError(f"{robot} has other numbers today: {', '.join(described.joint_names)}")
    groups = [group.name for group in described.groups for _ in range(group.dof)]
    bases = np.zeros(described.dim, np.bool_)
    bases[list(described.speed_dims)] = True
    gripping = np.zeros(described.dim, np.bool_)
    gripping[list(described.gripper_dims)] = True
    return JointSpecs(
        tuple(names), tuple(groups), gripping, bases, described.lower, described.upper, described.velocity
    )


def unknown_joints(names: Sequence[str]) -> JointSpecs:
    """Numbers of which only the names are known."""
    unknown = np.full(len(names), _UNKNOWN)
    gripping = np.array([GRIPPER in name.lower() for name in names], np.bool_)
    groups = tuple(name.partition(".")[0] for name in names)
    return JointSpecs(
        tuple(names), groups, gripping, np.zeros(len(names), np.bool_), unknown, unknown, unknown
    )


def groups_of(names: Sequence[str]) -> list[str]:
    """The groups that names as GROUP.JOINT are of, each once, in their order."""
    return list(dict.fromkeys(name.partition(".")[0] for name in names))
