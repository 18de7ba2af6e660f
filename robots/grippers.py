"""Gripper of a group: from its table and a deployment's choices, with the frame of its fingertips."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robots.description import GripperTable, GroupTable
from robots.errors import RobotError, check_movers
from robots.places import unit_quaternion
from robots.robot import Gripper
from robots.rotations import Float64, matrix_of_quaternion
from robots.urdf import Urdf

_HYSTERESIS = 0.05  # share of the travel


@dataclass(frozen=True, slots=True)
class GripperChoice:
    """Changes of a deployment to a gripper; None keeps the value of the robot's description."""

    binary: bool | None = None
    threshold: float | None = None
    hysteresis: float | None = None
    open: float | None = None
    close: float | None = None


def apply_gripper_choices(
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
    fields = {key: value for key in GripperChoice.__slots__ if (value := getattr(choice, key)) is not None}
    if choice.binary is False:
        fields = {"threshold": None, "hysteresis": None} | fields
    return group.model_copy(update={"gripper": group.gripper.model_copy(update=fields)})


def gripper_of(key: str, tree: Urdf, table: GripperTable, dof: int) -> Gripper:
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
        **table.model_dump(exclude={"velocity", "tip", "hysteresis", "fingers", "apart", "force"}),
        hysteresis=_hysteresis(key, table),
        fingers=_fingers(key, tree, table.fingers),
        apart=_apart(key, table),
        force=table.force,
    )


def _hysteresis(key: str, table: GripperTable) -> float | None:
    if table.threshold is None:
        if table.hysteresis is not None:
            raise RobotError(
                f"{key}.gripper.hysteresis = {table.hysteresis}; allowed only with binary = true"
            )
        return None
    nearer = min(abs(table.threshold - table.open), abs(table.threshold - table.close))
    most = 2 * nearer / abs(table.open - table.close)
    if table.hysteresis is None:
        return min(_HYSTERESIS, most)
    if table.hysteresis > most:
        raise RobotError(
            f"{key}.gripper.hysteresis = {table.hysteresis}; allowed with the threshold {table.threshold}: 0 to "
            f"{most:g} of the travel, or it could not switch back"
        )
    return table.hysteresis


def _apart(key: str, table: GripperTable) -> tuple[float, float] | None:
    if table.apart is None:
        return (0.0, abs(table.open - table.close)) if table.unit == "m" else None
    closed, opened = table.apart
    if not 0 <= closed < opened:
        raise RobotError(f"{key}.gripper.apart = {table.apart}; allowed: 0 <= at close < at open [m]")
    return closed, opened


def _fingers(key: str, tree: Urdf, table: Mapping[str, list[float]]) -> dict[str, tuple[float, float]]:
    check_movers(f"{key}.gripper.fingers", tree, table)
    return {name: (at_lower, at_upper) for name, (at_lower, at_upper) in table.items()}


def tip_frame(key: str, tree: Urdf, table: GroupTable) -> Float64 | None:
    """Return the frame of the fingertips in `eef_link` [4, 4]: as declared, else derived from the URDF.

    None for a group without gripper or end effector.
    """
    if table.eef_link is None or table.gripper is None:
        return None
    declared = table.gripper.tip
    if declared is None:
        tip = _between_fingers(tree, table.eef_link)
    else:
        tip = np.eye(4)
        tip[:3, :3] = matrix_of_quaternion(
            np.array(unit_quaternion(f"{key}.gripper.tip.wxyz", declared.wxyz))
        )
        tip[:3, 3] = declared.xyz
    tip.setflags(write=False)
    return tip


def _between_fingers(tree: Urdf, link: str) -> Float64:
    """Return the frame of the fingertips [4, 4] relative to a link whose children slide.

    The origin of the frame is midway between the origins of the sliding children. The frame is rotated only about the z
    axis of the link, so that its y axis is the direction in which the first sliding child slides. If no child slides,
    the frame is the identity. If the first one slides along z, the frame is not rotated.
    """
    tip = np.eye(4)
    fingers = [joint for joint in tree.children(link) if joint.kind == "prismatic"]
    if not fingers:
        return tip
    tip[:3, 3] = np.mean([finger.origin[:3, 3] for finger in fingers], axis=0)
    x, y, _ = fingers[0].origin[:3, :3] @ fingers[0].axis
    across = float(np.hypot(x, y))
    if across > 1e-6:
        cosine, sine = abs(y) / across, -x / across * (1 if y >= 0 else -1)
        tip[:2, :2] = [[cosine, -sine], [sine, cosine]]
    return tip
