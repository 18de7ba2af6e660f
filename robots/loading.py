"""Makes a Robot of a folder with robot.toml and a URDF, and checks one against the other."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from robots import description, urdf
from robots.chain import Chain
from robots.copies import copy_of
from robots.description import TABLE, GripperTable, GroupTable, OverrideTable, PlaceTable, RobotTable
from robots.errors import RobotError
from robots.robot import Camera, Gripper, Group, Robot
from robots.rotations import Float64, matrix_of_quaternion
from robots.urdf import Urdf

_HERE = Path(__file__).resolve().parent
_FILE = "robot.toml"


def names() -> tuple[str, ...]:
    """The robots that come with the program, and those in the folders of $EVA_ROBOTS (as in a search path)."""
    return tuple(sorted(_known()))


def _known() -> dict[str, Path]:
    """Folders by name; what comes with the program is never replaced by another of the same name."""
    further = [Path(part).expanduser() for part in os.environ.get("EVA_ROBOTS", "").split(os.pathsep) if part]
    found: dict[str, Path] = {}
    for root in (_HERE, *further):
        for file in sorted(root.glob(f"*/{_FILE}")):
            found.setdefault(file.parent.name, file.parent.resolve())
    return found


@dataclass(frozen=True, slots=True)
class GripperChoice:
    """What a deployment says otherwise of a gripper; None keeps what the robot's description says."""

    binary: bool | None = None
    threshold: float | None = None
    open: float | None = None
    close: float | None = None


def load(
    robot: str | Path,
    groups: Sequence[str] | None = None,
    grippers: Mapping[str, GripperChoice] | None = None,
) -> Robot:
    """The robot of that name or in that folder; RobotError says which file and key, given, allowed.

    `groups` are those that are part of it, in the description's order; without, all that are not optional.
    `grippers` are choices by the name of their group.
    """
    folder = _folder(robot)
    file = folder / _FILE
    table = description.read(file)
    tree = urdf.read(folder / table.urdf)
    _refuse_twice(file, "groups", [group.name for group in table.groups])
    _refuse_twice(file, "cameras", list(table.cameras.values()))
    _check_ros(file, table)
    _check_collision(file, table, tree)
    chosen = _with_grippers(file, _chosen(file, table, groups), grippers or {})
    starts = np.cumsum([0, *(len(entry.joints) for entry in chosen)]).tolist()
    made = tuple(_group(file, tree, entry, start) for entry, start in zip(chosen, starts, strict=False))
    made = tuple(
        _with_chain(file, tree, entry, group, made) for entry, group in zip(chosen, made, strict=True)
    )
    limits = [_limits(file, tree, entry) for entry in chosen]
    lower, upper, velocity = (
        _frozen([number for part in limits for number in getattr(part, side)])
        for side in ("lower", "upper", "velocity")
    )
    return Robot(
        name=folder.name,
        title=table.title,
        folder=folder,
        urdf=tree.path,
        groups=made,
        cameras=tuple(Camera(name, key) for name, key in table.cameras.items()),
        poses=_poses(file, table, made, lower, upper),
        lower=lower,
        upper=upper,
        velocity=velocity,
        control_rate=table.control_rate,
        limits_source=table.limits_source,
        overrides=tuple(sentence for part in limits for sentence in part.overrides),
        measures=frozenset(table.measures),
        mount_frame=table.mount_frame,
        stand=_place(f"{file}: stand", table.stand),
        collision=table.collision,
        ros=table.ros,
    )


def _chosen(file: Path, table: RobotTable, groups: Sequence[str] | None) -> list[GroupTable]:
    """The groups that are part of the robot, in the file's order."""
    known = [group.name for group in table.groups]
    unknown = [name for name in groups or () if name not in known]
    if unknown or (groups is not None and not groups):
        raise RobotError(f"{file}: groups {unknown or groups} were chosen; allowed: {', '.join(known)}")
    if groups is None:
        return [group for group in table.groups if not group.optional]
    return [group for group in table.groups if group.name in groups]


def _with_grippers(
    file: Path, groups: list[GroupTable], choices: Mapping[str, GripperChoice]
) -> list[GroupTable]:
    having = [group.name for group in groups if group.gripper is not None]
    unknown = sorted(set(choices) - set(having))
    if unknown:
        raise RobotError(
            f"{file}: grippers of {', '.join(unknown)} were chosen; groups with a gripper: {', '.join(having)}"
        )
    return [_with_gripper(group, choices[group.name]) if group.name in choices else group for group in groups]


def _with_gripper(group: GroupTable, choice: GripperChoice) -> GroupTable:
    assert group.gripper is not None
    given = {key: value for key in GripperChoice.__slots__ if (value := getattr(choice, key)) is not None}
    if choice.binary is False:
        given["threshold"] = None
    return group.model_copy(update={"gripper": group.gripper.model_copy(update=given)})


def _check_ros(file: Path, table: RobotTable) -> None:
    """Topics may name only cameras and groups that there are."""
    if table.ros is None:
        return
    for key, given, known in (
        ("cameras", table.ros.cameras, list(table.cameras)),
        ("groups", table.ros.groups, [group.name for group in table.groups]),
    ):
        unknown = [name for name in given if name not in known]
        if unknown:
            raise RobotError(f"{file}: ros.{key} names {', '.join(unknown)}; allowed: {', '.join(known)}")


def _check_collision(file: Path, table: RobotTable, tree: Urdf) -> None:
    """Collision may name only links of the URDF; in pairs also those of one group's copy, and the table."""
    collision = table.collision
    groups = [group.name for group in table.groups]
    for key, named in (("capsules", list(collision.capsules)), ("without", collision.without)):
        if unknown := [link for link in named if link not in tree.links]:
            allowed = ", ".join(sorted(tree.links))
            raise RobotError(f"{file}: collision.{key} names {', '.join(unknown)}; allowed: {allowed}")
    known = {*tree.links, TABLE, *(f"{group}/{link}" for group in groups for link in tree.links)}
    for pair in collision.ignore:
        if unknown := [link for link in pair if link not in known]:
            raise RobotError(
                f"{file}: collision.ignore names {', '.join(unknown)}; allowed: {TABLE}, a link, or GROUP/LINK, of "
                f"{', '.join(sorted(tree.links))}"
            )


@dataclass(frozen=True, slots=True)
class _Limits:
    lower: list[float]
    upper: list[float]
    velocity: list[float]
    overrides: list[str]


def _folder(robot: str | Path) -> Path:
    known = _known()
    if isinstance(robot, str) and robot in known:
        return known[robot]
    folder = Path(robot)
    if not (folder / _FILE).is_file():
        raise RobotError(f"no robot {str(robot)!r}; known: {', '.join(known)}, or a folder with {_FILE}")
    return folder.resolve()


def _frozen(numbers: Sequence[float]) -> Float64:
    array = np.array(numbers, dtype=np.float64)
    array.setflags(write=False)
    return array


def _refuse_twice(file: Path, key: str, given: list[str]) -> None:
    twice = sorted({name for name in given if given.count(name) > 1})
    if twice:
        raise RobotError(f"{file}: {key}: {', '.join(twice)} more than once; each is allowed once")


def _group(file: Path, tree: Urdf, table: GroupTable, start: int) -> Group:
    key = f"{file}: groups.{table.name}"
    _refuse_twice(file, f"groups.{table.name}.joints", table.joints)
    gripper = None if table.gripper is None else _gripper(key, tree, table.gripper, len(table.joints))
    movers = len(table.joints) - (gripper is not None)
    if len(table.urdf_joints) != movers:
        raise RobotError(
            f"{key}.urdf_joints names {len(table.urdf_joints)} joints; allowed: {movers}, one per joint"
        )
    for name in filter(None, table.urdf_joints):
        joint = tree.joint(name)
        if joint.kind == "fixed" or joint.mimic is not None:
            raise RobotError(
                f"{key}.urdf_joints: {name} is fixed or a mimic; allowed: joints that move by themselves"
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
        mount=_place(f"{key}.mount", table.mount),
        tip=_tip(key, tree, table),
        slice=slice(start, start + len(table.joints)),
    )


def _gripper(key: str, tree: Urdf, table: GripperTable, dof: int) -> Gripper:
    if table.index >= dof:
        raise RobotError(f"{key}.gripper.index = {table.index}; allowed: 0 to {dof - 1}")
    for name, value in (("open", table.open), ("close", table.close)):
        if not table.lower <= value <= table.upper:
            raise RobotError(f"{key}.gripper.{name} = {value}; allowed: {table.lower} to {table.upper}")
    if table.open == table.close:
        raise RobotError(f"{key}.gripper.open = {table.open} is also close; allowed: two different values")
    if table.binary != (table.threshold is not None):
        raise RobotError(f"{key}.gripper.threshold = {table.threshold}; needed if and only if binary = true")
    low, high = sorted((table.open, table.close))
    if table.threshold is not None and not low < table.threshold < high:
        raise RobotError(f"{key}.gripper.threshold = {table.threshold}; allowed: between {low} and {high}")
    return Gripper(
        **table.model_dump(exclude={"velocity", "tip", "fingers", "apart"}),
        fingers=_fingers(key, tree, table.fingers),
        apart=_apart(key, table),
    )


def _apart(key: str, table: GripperTable) -> tuple[float, float] | None:
    if table.apart is None:
        return (0.0, abs(table.open - table.close)) if table.unit == "m" else None
    closed, opened = table.apart
    if not 0 <= closed < opened:
        raise RobotError(f"{key}.gripper.apart = {table.apart}; allowed: 0 <= at close < at open [m]")
    return closed, opened


def _fingers(key: str, tree: Urdf, table: Mapping[str, list[float]]) -> dict[str, tuple[float, float]]:
    for name in table:
        joint = tree.joint(name)
        if joint.kind == "fixed" or joint.mimic is not None:
            raise RobotError(
                f"{key}.gripper.fingers: {name} is fixed or a mimic; allowed: joints that move by themselves"
            )
    return {name: (at_lower, at_upper) for name, (at_lower, at_upper) in table.items()}


def _with_chain(file: Path, tree: Urdf, table: GroupTable, group: Group, groups: Sequence[Group]) -> Group:
    """The group with the chain of its own joints, and with the chain that carries it where others move it."""
    if table.eef_link is None and table.frame is None and not table.pinned:
        return group
    key = f"{file}: groups.{table.name}"
    if table.eef_link is None or table.frame is None:
        raise RobotError(f"{key}: eef_link and frame make an arm together; allowed: both or neither")
    if "" in table.urdf_joints:
        raise RobotError(f'{key}.urdf_joints has ""; allowed for an arm: joints of the URDF')
    way = tree.between(table.frame, table.eef_link)
    movers = {
        name: int(dim)
        for other in copy_of(group, groups)
        if other is not group
        for name, dim in zip(other.urdf_joints, other.joint_dims, strict=True)
    }
    carried = [joint.name for joint in way if joint.name in movers]
    if not carried:
        return replace(group, chain=Chain(tree, table.frame, table.eef_link, table.urdf_joints, table.pinned))
    root = next(joint.parent for joint in way if joint.name in table.urdf_joints)
    pinned = {name: value for name, value in table.pinned.items() if name not in carried}
    if beyond := [joint.name for joint in tree.between(root, table.eef_link) if joint.name in movers]:
        raise RobotError(f"{key}: {', '.join(beyond)} of other groups lie among its own joints")
    return replace(
        group,
        chain=Chain(tree, root, table.eef_link, table.urdf_joints, pinned),
        carrier=Chain(tree, table.frame, root, carried, pinned),
        carrier_dims=np.array([movers[name] for name in carried], dtype=np.intp),
    )


def _place(key: str, table: PlaceTable | None) -> Float64:
    if table is None:
        return _frozen([0, 0, 0, 1, 0, 0, 0])
    return _frozen([*table.xyz, *_unit(f"{key}.wxyz", table.wxyz)])


def _unit(key: str, wxyz: list[float]) -> list[float]:
    norm = float(np.linalg.norm(wxyz))
    if abs(norm - 1) > 1e-6:
        raise RobotError(f"{key} has length {norm}; allowed: 1 within 1e-6")
    return [part / norm for part in wxyz]


def _tip(key: str, tree: Urdf, table: GroupTable) -> Float64 | None:
    """The frame of the fingertips in `eef_link`: what is declared, else what the URDF's fingers show."""
    if table.eef_link is None or table.gripper is None:
        return None
    declared = table.gripper.tip
    if declared is None:
        tip = _between_fingers(tree, table.eef_link)
    else:
        tip = np.eye(4)
        tip[:3, :3] = matrix_of_quaternion(np.array(_unit(f"{key}.gripper.tip.wxyz", declared.wxyz)))
        tip[:3, 3] = declared.xyz
    tip.setflags(write=False)
    return tip


def _between_fingers(tree: Urdf, link: str) -> Float64:
    """Midway between the origins of the link's sliding children, in the link's axes turned about z only.

    y is the way the first of them slides; the link itself where nothing slides on it across its z.
    """
    tip = np.eye(4)
    fingers = [joint for joint in tree.joints.values() if joint.parent == link and joint.kind == "prismatic"]
    if not fingers:
        return tip
    tip[:3, 3] = np.mean([finger.origin[:3, 3] for finger in fingers], axis=0)
    x, y, _ = fingers[0].origin[:3, :3] @ fingers[0].axis
    across = float(np.hypot(x, y))
    if across > 1e-6:
        cosine, sine = abs(y) / across, -x / across * (1 if y >= 0 else -1)
        tip[:2, :2] = [[cosine, -sine], [sine, cosine]]
    return tip


def _limits(file: Path, tree: Urdf, table: GroupTable) -> _Limits:
    """The limits of a group's joints, of its URDF joints or the override, and of the gripper table."""
    key = f"{file}: groups.{table.name}"
    _refuse_twice(file, f"groups.{table.name}.overrides", [override.joint for override in table.overrides])
    overrides = {override.joint: override for override in table.overrides}
    wire = list(table.joints)
    if table.gripper is not None:
        del wire[table.gripper.index]
    for name in overrides:
        if name not in wire:
            raise RobotError(f"{key}.overrides names joint {name!r}; allowed: {', '.join(wire)}")
    limits = _Limits([], [], [], [])
    for name, urdf_name in zip(wire, table.urdf_joints, strict=True):
        for side, values in (("lower", limits.lower), ("upper", limits.upper), ("velocity", limits.velocity)):
            given: float | None = getattr(tree.joint(urdf_name), side) if urdf_name else None
            value = _overridden(f"{table.name}.{name}", side, given, overrides.get(name), limits.overrides)
            if value is None:
                raise RobotError(
                    f"{key}: joint {name!r}: the URDF gives no {side} for {urdf_name or 'it'}; needed: an override"
                )
            values.append(value)
        if limits.lower[-1] >= limits.upper[-1] or limits.velocity[-1] <= 0:
            raise RobotError(
                f"{key}: joint {name!r} has range {limits.lower[-1]} to {limits.upper[-1]} at velocity "
                f"{limits.velocity[-1]}; allowed: lower < upper, velocity > 0"
            )
    if table.gripper is not None:
        limits.lower.insert(table.gripper.index, table.gripper.lower)
        limits.upper.insert(table.gripper.index, table.gripper.upper)
        limits.velocity.insert(table.gripper.index, table.gripper.velocity)
    return limits


def _overridden(
    joint: str, side: str, given: float | None, override: OverrideTable | None, sentences: list[str]
) -> float | None:
    replacement: float | None = None if override is None else getattr(override, side)
    if override is None or replacement is None:
        return given
    sentences.append(f"{joint} {side} {given} -> {replacement}: {override.reason}")
    return replacement


def _poses(
    file: Path, table: RobotTable, groups: Sequence[Group], lower: Float64, upper: Float64
) -> dict[str, Float64]:
    if "home" not in table.poses:
        raise RobotError(f"{file}: poses: {', '.join(table.poses) or 'none'} given; needed: home")
    known = [group.name for group in table.groups]
    for name, parts in table.poses.items():
        if list(parts) != known:
            raise RobotError(f"{file}: poses.{name} gives {', '.join(parts)}; needed: {', '.join(known)}")
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
    return _frozen([value for group in groups for value in parts[group.name]])
