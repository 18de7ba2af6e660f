"""Which groups share one copy of the URDF: a file that describes one of several equal arms stands for each of them."""

from __future__ import annotations

from collections.abc import Sequence

from robots.robot import Group


def urdf_copies(groups: Sequence[Group]) -> list[list[Group]]:
    """The groups, sorted into copies of the URDF such that no joint is moved twice in one copy."""
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
    """The groups of the copy that `group` belongs to."""
    return next(members for members in urdf_copies(groups) if group in members)
