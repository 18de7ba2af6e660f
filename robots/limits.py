"""Limits of a group's numbers, from the URDF, overrides and the gripper."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from robots.description import GroupTable, OverrideTable
from robots.errors import RobotError, reject_duplicates
from robots.urdf import Urdf

FASTEST = 10.0  # [rad/s], [m/s] arm joints with a higher limit probably have a placeholder


@dataclass(frozen=True, slots=True)
class Limits:
    lower: list[float]
    upper: list[float]
    velocity: list[float]
    overrides: list[str]


def group_limits(file: Path, tree: Urdf, table: GroupTable) -> Limits:
    """Return the limits of a group's joints, from the URDF or the overrides, and from the gripper table.

    Raises:
        RobotError: If a limit is missing or invalid.
    """
    key = f"{file}: groups.{table.name}"
    reject_duplicates(
        file, f"groups.{table.name}.overrides", [override.joint for override in table.overrides]
    )
    overrides = {override.joint: override for override in table.overrides}
    wire = list(table.joints)
    if table.gripper is not None:
        del wire[table.gripper.index]
    for name, override in overrides.items():
        if name not in wire:
            raise RobotError(f"{key}.overrides names joint {name!r}; allowed: {', '.join(wire)}")
        if override.lower is override.upper is override.velocity is None:
            raise RobotError(f"{key}.overrides: {name} changes nothing; needed: lower, upper or velocity")
    limits = Limits([], [], [], [])
    for name, urdf_name in zip(wire, table.urdf_joints, strict=True):
        for side, values in (("lower", limits.lower), ("upper", limits.upper), ("velocity", limits.velocity)):
            declared: float | None = getattr(tree.joint(urdf_name), side) if urdf_name else None
            value = _overridden(f"{table.name}.{name}", side, declared, overrides.get(name), limits.overrides)
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
    joint: str, side: str, declared: float | None, override: OverrideTable | None, sentences: list[str]
) -> float | None:
    replacement: float | None = None if override is None else getattr(override, side)
    if override is None or replacement is None:
        return declared
    sentences.append(f"{joint} {side} {declared} -> {replacement}: {override.reason}")
    return replacement
