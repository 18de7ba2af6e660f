"""Findings on a robot's description, as sentences: `python -m robots check`."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robots import description, urdf
from robots.body import Body
from robots.clearance import collision_problems
from robots.description import GroupTable, OverrideTable, RobotTable, RosGroupTable
from robots.limits import FASTEST
from robots.loading import load_robot, load_robot_with_optional_groups
from robots.robot import Group, Robot, urdf_copies
from robots.rotations import Float64
from robots.urdf import Urdf
from robots.visuals import scene_of

GUESS = "GUESS"  # mark of unverified values in a drafted robot.toml


@dataclass(frozen=True, slots=True)
class Inspection:
    """Findings on a robot: `lines` describe the declarations, `warnings` are points to verify, `errors` are faults."""

    lines: tuple[str, ...]
    warnings: tuple[str, ...]
    errors: tuple[str, ...]


def inspect_robot(name: str | Path) -> Inspection:
    """Return the findings on a robot with and without its optional groups.

    Raises:
        RobotError: If it cannot be loaded.
    """
    usual = load_robot(name)
    file = usual.folder / "robot.toml"
    table = description.read(file)
    whole = load_robot_with_optional_groups(name)
    tree = urdf.read(whole.urdf)
    scene_of(whole)  # raises for missing meshes
    lines = [
        *_heading(usual, table, whole),
        *_standing(whole, tree),
        *(line for group in whole.groups for line in _group(whole, group, table)),
        *_poses(usual, whole),
        *_ros(table),
        *_lerobot(table),
    ]
    return Inspection(
        tuple(lines),
        tuple(f"{file}: {sentence}" for sentence in _warnings(usual, whole, table, file)),
        tuple(
            f"{file}: {sentence}"
            for sentence in dict.fromkeys([*collision_problems(usual), *collision_problems(whole)])
        ),
    )


def _heading(robot: Robot, table: RobotTable, whole: Robot) -> Iterator[str]:
    yield f"{robot.name}: {robot.title}"
    yield f"folder: {robot.folder}"
    yield f"{robot.dim} numbers, {robot.control_rate:g} Hz"
    optional = [group.name for group in table.groups if group.optional]
    yield f"groups: {', '.join(group.name for group in robot.groups)}"
    if optional:
        yield f"optional groups: {', '.join(optional)}; with all of them {whole.dim} numbers"
    cameras = [f"{camera.name} -> {camera.key}" for camera in robot.cameras]
    yield f"cameras: {', '.join(cameras) or 'none'}"
    yield f"limits: {robot.limits_source}"


def _standing(robot: Robot, tree: Urdf) -> Iterator[str]:
    """Yield lines about the URDF, the copies of its tree and the copies' poses."""
    members = urdf_copies(robot.groups)
    moving = [joint.name for joint in tree.joints.values() if joint.is_independent]
    yield f"{tree.path.name}: {len(tree.links)} links from {tree.root}, {len(moving)} joints that move by themselves"
    commanded = {name for group in robot.groups for name in _driven(group)}
    if still := [name for name in moving if name not in commanded]:
        yield f"  that no group moves: {', '.join(still)}"
    yield f"{robot.mount_frame} stands in the scene at {_place(robot.stand)}"
    for groups in members:
        yield (
            f"  a copy of {tree.root} for {', '.join(group.name for group in groups)} at {_place(groups[0].mount)} "
            f"in {robot.mount_frame}"
        )


def _driven(group: Group) -> tuple[str, ...]:
    return (*group.urdf_joints, *(group.gripper.fingers if group.gripper else ()))


def _group(robot: Robot, group: Group, table: RobotTable) -> Iterator[str]:
    declared = next(entry for entry in table.groups if entry.name == group.name)
    optional = ", optional" if declared.optional else ""
    yield f"{group.name} ({group.kind}{optional}): {group.dof} numbers"
    yield from _numbers(robot, group, declared)
    reasons: dict[str, list[str]] = {}
    for override in declared.overrides:
        reasons.setdefault(override.reason, []).append(override.joint)
    yield from (f"  overridden for {', '.join(joints)}: {reason}" for reason, joints in reasons.items())
    yield from _gripper(group)
    if group.chain is None:
        return
    pose = [f"{value:.5f}" for value in group.pose(robot.poses["home"])]
    place = f"position {', '.join(pose[:3])} m, wxyz {', '.join(pose[3:])}"
    yield f"{group.name}: {group.eef_link} in {group.frame} at home: {place}"
    if group.carrier is not None:
        yield f"  carried by {', '.join(group.carrier.joints)}"
    if declared.pinned:
        frozen = ", ".join(f"{joint} = {value:g}" for joint, value in declared.pinned.items())
        yield f"  pinned where no group moves them: {frozen}"


def _numbers(robot: Robot, group: Group, declared: GroupTable) -> Iterator[str]:
    """Yield a line for each number of a group: its limits, where they come from, and its value at home."""
    home = robot.poses["home"]
    overrides = {override.joint: override for override in declared.overrides}
    joints = iter(group.urdf_joints)
    for index, name in enumerate(robot.joint_names[group.slice]):
        dim = int(group.slice.start) + index
        low, high = robot.lower[dim], robot.upper[dim]
        note = ""
        if group.gripper is not None and index == group.gripper.index:
            source = "gripper"
        else:
            joint = next(joints)
            source = f"URDF {joint}" if joint else "not in the URDF"
            source += _overridden(overrides.get(group.joints[index]))
            note = "  home is on a limit" if home[dim] in (low, high) else ""
        yield (
            f"  {name:24} {low:9.4f} to {high:9.4f}, at most {robot.velocity[dim]:g}/s, home {home[dim]:g} "
            f"({source}){note}"
        )


def _overridden(override: OverrideTable | None) -> str:
    if override is None:
        return ""
    sides = [side for side in ("lower", "upper", "velocity") if getattr(override, side) is not None]
    return f"; overridden: {', '.join(sides)}"


def _gripper(group: Group) -> Iterator[str]:
    gripper = group.gripper
    if gripper is None:
        return
    switch = "any value between"
    if gripper.threshold is not None:
        switch = f"binary, switches at {gripper.threshold:g}, hysteresis {gripper.hysteresis:g} of its travel"
    yield f"  gripper in {gripper.unit}: open {gripper.open:g}, close {gripper.close:g}, {switch}"
    if gripper.apart is not None:
        closed, opened = (1000 * value for value in gripper.apart)
        yield f"  fingers {closed:g} mm apart when closed, {opened:g} mm when open; drawn: {', '.join(gripper.fingers)}"
    if group.tip is not None:
        tip, axis = (", ".join(f"{value:.4f}" for value in group.tip[:3, column]) for column in (3, 2))
        yield f"  fingertips at {tip} m in {group.eef_link}, pointing along {axis}"


def _poses(usual: Robot, whole: Robot) -> Iterator[str]:
    body = Body(whole)
    yield f"poses: {', '.join(whole.poses)}"
    for name, q in whole.poses.items():
        for arm in whole.arms:
            x, y, z = body.poses(q)[body.link_of(arm.name, str(arm.eef_link)), :3, 3]
            yield f"  {name}: {arm.eef_link} of {arm.name} is at {x:.3f}, {y:.3f}, {z:.3f} m over the table's origin"


def _ros(table: RobotTable) -> Iterator[str]:
    if table.ros is None:
        yield "ros: no topics"
        return
    yield f"ros {table.ros.version}"
    yield from (f"  camera {name}: {topic}" for name, topic in table.ros.cameras.items())
    for name, group in table.ros.groups.items():
        topics = {key: getattr(group, key) for key in RosGroupTable.model_fields}
        yield f"  {name}: {', '.join(f'{key} {topic}' for key, topic in topics.items() if topic is not None)}"


def _lerobot(table: RobotTable) -> Iterator[str]:
    for group, joints in (table.lerobot.joints if table.lerobot else {}).items():
        yield f"lerobot {group}: {', '.join(f'{joint} {entry.feature}' for joint, entry in joints.items())}"


def _warnings(usual: Robot, whole: Robot, table: RobotTable, file: Path) -> Iterator[str]:
    if "ready" not in whole.poses:
        yield 'poses: no "ready"; a deployment needs one clear of the workspace to begin from'
    for name, q in whole.poses.items():
        touching = np.isclose(q, whole.lower) | np.isclose(q, whole.upper)
        touching[list(whole.gripper_dims)] = False
        if touching.any():
            on = [joint for joint, at in zip(whole.joint_names, touching, strict=True) if at]
            yield f"poses.{name}: {', '.join(on)}: on a limit, where a robot at rest may be found beyond it"
    yield from _low_fingertips(whole)
    for entry in table.groups:
        group = whole.group(entry.name)
        yield from _group_warnings(whole, group, entry)
    if not (whole.folder / "README.md").is_file():
        yield "no README.md beside it; it should say what was verified and what is a placeholder"
    if guesses := _guesses(file):
        yield f"{GUESS} stands in lines {', '.join(map(str, guesses))}: verify each, then delete the word"


def _low_fingertips(robot: Robot) -> Iterator[str]:
    """Yield warnings about fingertips below the table, which the collision check allows on purpose."""
    body = Body(robot)
    for name, q in robot.poses.items():
        for arm in robot.arms:
            end = body.poses(q)[body.link_of(arm.name, str(arm.eef_link))]
            height = float((end if arm.tip is None else end @ arm.tip)[2, 3])
            if height < 0:
                deep = f"{-1000 * height:.0f} mm below the table"
                yield f"poses.{name}: the fingertips of {arm.name} are {deep}; see stand"


def _group_warnings(robot: Robot, group: Group, table: GroupTable) -> Iterator[str]:
    key = f"groups.{group.name}"
    placeholders = [entry.joint for entry in table.overrides if "placeholder" in entry.reason.lower()]
    if placeholders:
        yield f"{key}.overrides: {', '.join(placeholders)}: limits stand in for placeholders, or are some; verify them"
    endless = [
        joint
        for joint, low, high in zip(
            group.joints, robot.lower[group.slice], robot.upper[group.slice], strict=True
        )
        if not np.isfinite([low, high]).all()
    ]
    if endless:
        yield f"{key}: {', '.join(endless)}: no position limit; cables may want one, as an override"
    fast = [robot.joint_names[dim] for dim in group.joint_dims if robot.velocity[dim] > FASTEST]
    if fast and group.kind == "arm":
        yield f"{key}: {', '.join(fast)}: faster than {FASTEST:g} rad/s; is that the robot's or a placeholder?"
    if group.chain is not None and group.gripper is not None and group.gripper.apart is None:
        yield f"{key}.gripper.apart: not given; the simulated bench does not know how far its jaws open"


def _guesses(file: Path) -> list[int]:
    lines = file.read_text("utf-8").splitlines()
    return [number for number, line in enumerate(lines, 1) if re.search(rf"#.*\b{GUESS}\b", line)]


def _place(place: Float64) -> str:
    xyz, wxyz = (", ".join(f"{value:.4g}" for value in part) for part in (place[:3], place[3:]))
    return f"{xyz} m, wxyz {wxyz}"
