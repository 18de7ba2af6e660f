"""Kinematic chains of a robot's arms, the joints that carry the arms, and the mounts of their URDF copies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from robots.chain import Chain
from robots.description import GroupTable
from robots.errors import RobotError, error_context
from robots.robot import Group, copy_of, urdf_copies
from robots.urdf import Urdf


def check_arm(key: str, table: GroupTable) -> None:
    """Raise RobotError if a group declares only some of the keys that make it an arm.

    End effector and frame must be declared together; kind "arm", pinned joints and a tip of the gripper require both.
    """
    if (table.eef_link is None) != (table.frame is None):
        raise RobotError(f"{key}: eef_link and frame make an arm together; allowed: both or neither")
    if table.eef_link is not None:
        if "" in table.urdf_joints:
            raise RobotError(f'{key}.urdf_joints has ""; allowed for an arm: joints of the URDF')
        return
    if table.kind == "arm":
        raise RobotError(f'{key}.kind = "arm"; allowed without eef_link and frame: the other kinds')
    if table.pinned:
        raise RobotError(f"{key}.pinned: {', '.join(table.pinned)}; allowed only with eef_link and frame")
    if table.gripper is not None and table.gripper.tip is not None:
        raise RobotError(f"{key}.gripper.tip is a frame in eef_link; allowed only with eef_link and frame")


def build_arm_chain(
    file: Path, tree: Urdf, table: GroupTable, group: Group, groups: Sequence[Group]
) -> Group:
    """Return the group with the chain of its own joints; if other groups move its base, also with the carrier chain.

    A group without end effector is returned unchanged.
    """
    if table.eef_link is None or table.frame is None:
        return group
    key = f"{file}: groups.{table.name}"
    _check_pinned(f"{key}.pinned", tree, table)
    with error_context(f"{key}: from frame to eef_link"):
        path = tree.between(table.frame, table.eef_link)
    movers = {
        name: int(dim)
        for sibling in copy_of(group, groups)
        if sibling is not group
        for name, dim in zip(sibling.urdf_joints, sibling.joint_dims, strict=True)
    }
    carried = [joint.name for joint in path if joint.name in movers]
    if not carried:
        with error_context(key):
            chain = Chain(tree, table.frame, table.eef_link, table.urdf_joints, table.pinned)
        return replace(group, chain=chain)
    root = next((joint.parent for joint in path if joint.name in table.urdf_joints), None)
    if root is None:
        raise RobotError(f"{key}.urdf_joints: none lies between {table.frame} and {table.eef_link}")
    pinned = {name: value for name, value in table.pinned.items() if name not in carried}
    if beyond := [joint.name for joint in tree.between(root, table.eef_link) if joint.name in movers]:
        raise RobotError(f"{key}: {', '.join(beyond)} of other groups lie among its own joints")
    with error_context(key):
        own = Chain(tree, root, table.eef_link, table.urdf_joints, pinned)
        carrier = Chain(tree, table.frame, root, carried, pinned)
    return replace(
        group,
        chain=own,
        carrier=carrier,
        carrier_dims=np.array([movers[name] for name in carried], dtype=np.intp),
    )


def _check_pinned(key: str, tree: Urdf, table: GroupTable) -> None:
    """Raise RobotError unless the joints in `pinned` can move and are not moved by the group itself."""
    for name in table.pinned:
        with error_context(key):
            joint = tree.joint(name)
        if joint.kind == "fixed" or name in table.urdf_joints:
            raise RobotError(f"{key}: {name} is fixed or among urdf_joints; allowed: other joints that move")


def check_mounts(file: Path, tables: Sequence[GroupTable], groups: Sequence[Group]) -> None:
    """Raise RobotError if groups that share a copy of the URDF declare different mounts."""
    mounts = {table.name: table.mount for table in tables}
    for members in urdf_copies(groups):
        first = members[0].name
        for group in members[1:]:
            if mounts[group.name] is not None and mounts[group.name] != mounts[first]:
                raise RobotError(
                    f"{file}: groups.{group.name}.mount differs from that of {first}, with which it shares one copy "
                    "of the URDF; allowed: the same, or none"
                )
