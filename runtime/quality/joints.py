"""The robot's dimensions for the checks: groups, grippers and limits, if its description is available."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

import robots
from robots import RobotError
from runtime.quality.block import JointSpecs

GRIPPER = "gripper"  # part of a gripper's name, if no description identifies it
_UNKNOWN = np.nan


def known_joints(robot: str, names: Sequence[str]) -> JointSpecs:
    """Return the dimensions of a described robot.

    Raises RobotError if it is unknown or its dimensions have other names.
    """
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
    """Return dimensions of which only the names are known."""
    unknown = np.full(len(names), _UNKNOWN)
    gripping = np.array([GRIPPER in name.lower() for name in names], np.bool_)
    groups = tuple(name.partition(".")[0] for name in names)
    return JointSpecs(
        tuple(names), groups, gripping, np.zeros(len(names), np.bool_), unknown, unknown, unknown
    )


def groups_of(names: Sequence[str]) -> list[str]:
    """Return the groups of names in the form GROUP.JOINT, each once, in their order."""
    return list(dict.fromkeys(name.partition(".")[0] for name in names))
