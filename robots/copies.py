"""Assignment of groups to copies of the URDF: a file that describes one of several equal arms is used once per arm."""

from __future__ import annotations

from collections.abc import Sequence

from robots.robot import Group


def urdf_copies(groups: Sequence[Group]) -> list[list[Group]]:
    """Return the groups by copy of the URDF, such that each joint is moved at most once per copy."""
    found: list[tuple[set[str], list[Group]]] = []
    for group in groups:
        joints = {*filter(None, group.urdf_joints), *(group.gripper.fingers if group.gripper else ())}
        for taken, members in found:
            if not taken & joints:
                taken |= joints
                members.append(group)
                break
        else:
            found.append((joints, [group]))
    return [members for _, members in found]


def copy_of(group: Group, groups: Sequence[Group]) -> list[Group]:
    """Return the groups of the copy to which `group` belongs."""
    return next(members for members in urdf_copies(groups) if group in members)
