"""Units of the numbers of a robot's vector."""

from __future__ import annotations

from robots import urdf
from robots.robot import Group, Robot
from robots.urdf import Urdf


def units_of(robot: Robot) -> tuple[str, ...]:
    """Return the unit of every number: "rad", "m" for prismatic joints, a gripper's own, "" if it moves no link."""
    tree = urdf.read(robot.urdf)
    return tuple(unit for group in robot.groups for unit in _units(group, tree))


def _units(group: Group, tree: Urdf) -> list[str]:
    units = [_unit(tree, name) for name in group.urdf_joints]
    if group.gripper is not None:
        units.insert(group.gripper.index, group.gripper.unit)
    return units


def _unit(tree: Urdf, joint: str) -> str:
    if not joint:
        return ""
    return "m" if tree.joint(joint).kind == "prismatic" else "rad"
