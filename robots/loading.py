"""Loading of a Robot from a folder with robot.toml and URDF, with checks that both agree."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from robots import description, urdf
from robots.arms import build_arm_chain, check_arm, check_mounts
from robots.description import TABLE, GroupTable, RobotTable
from robots.errors import RobotError, check_movers, reject_duplicates
from robots.grippers import (
    GripperChoice,
    apply_gripper_choices,
    gripper_of,
    tip_frame,
)
from robots.limits import group_limits
from robots.places import pose_vector, read_only
from robots.robot import Camera, Group, Robot
from robots.rotations import Float64
from robots.urdf import Urdf

_HERE = Path(__file__).resolve().parent
_OF_BENCHES = _HERE.parent / "runtime" / "benches"  # robots of benchmarks, in the folders of their benches
_FILE = "robot.toml"


def robot_names() -> tuple[str, ...]:
    """Return the names of the included robots, and of those in the folders of $EVA_ROBOTS (a search path)."""
    return tuple(sorted(_find_folders(_HERE, *robot_folders())))


def is_described(name: str) -> bool:
    """Return True for the name of a robot that can be loaded: one of `robot_names`, or a bench's own robot."""
    return name in _find_folders()


def robot_folders() -> tuple[Path, ...]:
    """Return the folders of $EVA_ROBOTS, which contain additional robots."""
    parts = os.environ.get("EVA_ROBOTS", "").split(os.pathsep)
    return tuple(Path(part).expanduser() for part in parts if part)


def _find_folders(*roots: Path) -> dict[str, Path]:
    """Return the folders of robots by name; an included robot cannot be replaced by another of the same name.

    They are searched below `roots`; by default below all, with those of benches, which exist on their bench alone.
    """
    folders: dict[str, Path] = {}
    for root in roots or (_HERE, _OF_BENCHES, *robot_folders()):
        for file in sorted(root.glob(f"*/{_FILE}")):
            folders.setdefault(file.parent.name, file.parent.resolve())
    return folders


def load_robot(
    robot: str | Path,
    groups: Sequence[str] | None = None,
    grippers: Mapping[str, GripperChoice] | None = None,
) -> Robot:
    """Return the robot with that name, or in that folder.

    Args:
        robot: Name or folder.
        groups: Groups that the robot is to have, in the description's order; None for all that are not optional.
        grippers: Choices by group.

    Raises:
        RobotError: If it is invalid; the message names file and key, the given and the allowed values.
    """
    folder = _folder(robot)
    file = folder / _FILE
    table = description.read(file)
    tree = _tree(file, folder / table.urdf)
    reject_duplicates(file, "groups", [group.name for group in table.groups])
    reject_duplicates(file, "cameras", list(table.cameras.values()))
    _check_ros(file, table)
    _check_lerobot(file, table)
    _check_collision(file, table, tree)
    chosen = apply_gripper_choices(file, _chosen(file, table, groups), grippers or {})
    starts = np.cumsum([0, *(len(entry.joints) for entry in chosen)]).tolist()
    built = tuple(_group(file, tree, entry, start) for entry, start in zip(chosen, starts, strict=False))
    built = tuple(
        build_arm_chain(file, tree, entry, group, built) for entry, group in zip(chosen, built, strict=True)
    )
    check_mounts(file, chosen, built)
    limits = [group_limits(file, tree, entry) for entry in chosen]
    lower, upper, velocity = (
        read_only([number for part in limits for number in getattr(part, side)])
        for side in ("lower", "upper", "velocity")
    )
    return Robot(
        name=folder.name,
        title=table.title,
        folder=folder,
        urdf=tree.path,
        groups=built,
        cameras=tuple(Camera(name, key) for name, key in table.cameras.items()),
        poses=_poses(file, table, built, lower, upper),
        lower=lower,
        upper=upper,
        velocity=velocity,
        control_rate=table.control_rate,
        limits_source=table.limits_source,
        overrides=tuple(sentence for part in limits for sentence in part.overrides),
        mount_frame=table.mount_frame,
        stand=pose_vector(f"{file}: stand", table.stand),
        collision=table.collision,
        ros=table.ros,
        lerobot=table.lerobot,
    )


def load_robot_with_optional_groups(robot: str | Path) -> Robot:
    """Return the robot including all optional groups."""
    return load_robot(robot, [group.name for group in description.read(_folder(robot) / _FILE).groups])


def _chosen(file: Path, table: RobotTable, groups: Sequence[str] | None) -> list[GroupTable]:
    """Return the tables of the groups that the robot is to have, in the file's order.

    Raises: RobotError for unknown groups, or if there would be none.
    """
    names = [group.name for group in table.groups]
    unknown = [name for name in groups or () if name not in names]
    if unknown or (groups is not None and not groups):
        raise RobotError(f"{file}: groups {unknown or groups} were chosen; allowed: {', '.join(names)}")
    if groups is None:
        always = [group for group in table.groups if not group.optional]
        if not always:
            raise RobotError(
                f"{file}: groups: all are optional; needed: one that is always part of the robot"
            )
        return always
    return [group for group in table.groups if group.name in groups]


def _tree(file: Path, path: Path) -> Urdf:
    if not path.is_file():
        urdfs = ", ".join(sorted(urdf_path.name for urdf_path in path.parent.glob("*.urdf"))) or "none"
        raise RobotError(f"{file}: urdf = {path.name!r} is no file; URDFs in the folder: {urdfs}")
    return urdf.read(path)


def _check_ros(file: Path, table: RobotTable) -> None:
    """Raise RobotError if topics name unknown cameras or groups."""
    if table.ros is None:
        return
    for key, names, allowed in (
        ("cameras", table.ros.cameras, list(table.cameras)),
        ("groups", table.ros.groups, [group.name for group in table.groups]),
    ):
        unknown = [name for name in names if name not in allowed]
        if unknown:
            raise RobotError(f"{file}: ros.{key} names {', '.join(unknown)}; allowed: {', '.join(allowed)}")


def _check_lerobot(file: Path, table: RobotTable) -> None:
    """Raise RobotError if [lerobot] names unknown groups or joints."""
    joints = {group.name: group.joints for group in table.groups}
    for group, named in (table.lerobot.joints if table.lerobot else {}).items():
        if group not in joints:
            raise RobotError(f"{file}: lerobot.joints names {group}; allowed: {', '.join(joints)}")
        if unknown := [joint for joint in named if joint not in joints[group]]:
            raise RobotError(
                f"{file}: lerobot.joints.{group} names {', '.join(unknown)}; allowed: {', '.join(joints[group])}"
            )


def _check_collision(file: Path, table: RobotTable, tree: Urdf) -> None:
    """Raise RobotError if [collision] names unknown links.

    Its pairs may also contain GROUP/LINK and the table.
    """
    collision = table.collision
    groups = [group.name for group in table.groups]
    for key, named in (("capsules", list(collision.capsules)), ("without", collision.without)):
        if unknown := [link for link in named if link not in tree.links]:
            allowed = ", ".join(sorted(tree.links))
            raise RobotError(f"{file}: collision.{key} names {', '.join(unknown)}; allowed: {allowed}")
    names = {*tree.links, TABLE, *(f"{group}/{link}" for group in groups for link in tree.links)}
    for pair in collision.ignore:
        if unknown := [link for link in pair if link not in names]:
            raise RobotError(
                f"{file}: collision.ignore names {', '.join(unknown)}; allowed: {TABLE}, a link, or GROUP/LINK, of "
                f"{', '.join(sorted(tree.links))}"
            )


def _folder(robot: str | Path) -> Path:
    folders = _find_folders()
    if isinstance(robot, str) and robot in folders:
        return folders[robot]
    folder = Path(robot)
    if not (folder / _FILE).is_file():
        raise RobotError(f"no robot {str(robot)!r}; known: {', '.join(folders)}, or a folder with {_FILE}")
    return folder.resolve()


def _group(file: Path, tree: Urdf, table: GroupTable, start: int) -> Group:
    key = f"{file}: groups.{table.name}"
    reject_duplicates(file, f"groups.{table.name}.joints", table.joints)
    reject_duplicates(file, f"groups.{table.name}.urdf_joints", list(filter(None, table.urdf_joints)))
    check_arm(key, table)
    gripper = None if table.gripper is None else gripper_of(key, tree, table.gripper, len(table.joints))
    movers = len(table.joints) - (gripper is not None)
    if len(table.urdf_joints) != movers:
        raise RobotError(
            f"{key}.urdf_joints names {len(table.urdf_joints)} joints; allowed: {movers}, one per joint"
        )
    check_movers(f"{key}.urdf_joints", tree, filter(None, table.urdf_joints))
    if gripper is not None and (both := [name for name in gripper.fingers if name in table.urdf_joints]):
        raise RobotError(
            f"{key}.gripper.fingers: {', '.join(both)} is also among urdf_joints; allowed: others"
        )
    return Group(
        name=table.name,
        kind=table.kind or ("other" if table.eef_link is None else "arm"),
        joints=tuple(table.joints),
        urdf_joints=tuple(table.urdf_joints),
        gripper=gripper,
        eef_link=table.eef_link,
        frame=table.frame,
        chain=None,
        carrier=None,
        carrier_dims=np.empty(0, dtype=np.intp),
        mount=pose_vector(f"{key}.mount", table.mount),
        tip=tip_frame(key, tree, table),
        slice=slice(start, start + len(table.joints)),
    )


def _poses(
    file: Path, table: RobotTable, groups: Sequence[Group], lower: Float64, upper: Float64
) -> dict[str, Float64]:
    if "home" not in table.poses:
        raise RobotError(f"{file}: poses: {', '.join(table.poses) or 'none'} given; needed: home")
    names = [group.name for group in table.groups]
    for name, parts in table.poses.items():
        if list(parts) != names:
            raise RobotError(f"{file}: poses.{name} gives {', '.join(parts)}; needed: {', '.join(names)}")
    return {
        name: _pose(f"{file}: poses.{name}", parts, groups, lower, upper)
        for name, parts in table.poses.items()
    }


def _pose(
    key: str, parts: dict[str, list[float]], groups: Sequence[Group], lower: Float64, upper: Float64
) -> Float64:
    for group in groups:
        if len(parts[group.name]) != group.dof:
            raise RobotError(f"{key}.{group.name} has {len(parts[group.name])} numbers; needed: {group.dof}")
        for joint, value, low, high in zip(
            group.joints, parts[group.name], lower[group.slice], upper[group.slice], strict=True
        ):
            if not low <= value <= high:
                raise RobotError(f"{key}.{group.name}: {joint} = {value}; allowed: {low} to {high}")
    return read_only([value for group in groups for value in parts[group.name]])
