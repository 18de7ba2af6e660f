"""Placeholders for limits that a URDF lacks, or states with unrealistic values."""

from __future__ import annotations

import math

from robots.description import OverrideTable
from robots.limits import FASTEST
from robots.urdf import Joint

_TURN, _SLIDE = 3.1416, 0.5  # [rad] to both sides, [m]
_SPEED, _SLIDING = 1.0, 0.1  # [rad/s], [m/s]
_WIDEST = 4 * math.pi + 0.01  # [rad] arm joints have at most two turns


def placeholder_limits(joint: Joint) -> OverrideTable | None:
    """Return the placeholder for unusable limits of a joint; None if the URDF's are usable."""
    bad_range, bad_speed = _positions(joint), _speeds(joint)
    if not (bad_range or bad_speed):
        return None
    slides = joint.kind == "prismatic"
    travel = _SLIDE if slides else _TURN
    speed = _SLIDING if slides else _SPEED
    return OverrideTable(
        joint=joint.name,
        lower=-travel if bad_range else None,
        upper=travel if bad_range else None,
        velocity=speed if bad_speed else None,
        reason=f"{' and '.join([*bad_range, *bad_speed])}: a placeholder, verify it on the robot",
    )


def _positions(joint: Joint) -> list[str]:
    lower, upper = joint.lower, joint.upper
    if joint.kind == "continuous":
        return ["turns without end in the URDF"]
    if lower is None or upper is None:
        return ["the URDF gives no range"]
    if lower >= upper:
        return [f"the URDF's range is {lower:g} to {upper:g}"]
    if joint.kind == "revolute" and upper - lower > _WIDEST:
        return [f"the URDF's {lower:g} to {upper:g} rad is no real range"]
    return []


def _speeds(joint: Joint) -> list[str]:
    if joint.velocity is None or joint.velocity <= 0:
        return ["the URDF gives no velocity"]
    if joint.velocity > FASTEST:
        return [f"the URDF's {joint.velocity:g}/s is faster than arms are"]
    return []
