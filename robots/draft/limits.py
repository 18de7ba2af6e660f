"""Placeholders for limits that a URDF lacks, or gives with unrealistic values."""

from __future__ import annotations

import math
from dataclasses import dataclass

from robots.urdf import Joint

_TURN, _SLIDE = 3.1416, 0.5  # [rad] to both sides, [m]
_SPEED, _SLIDING = 1.0, 0.1  # [rad/s], [m/s]
_WIDEST = 4 * math.pi + 0.01  # [rad] arm joints have at most two turns
FASTEST = 10.0  # [rad/s], [m/s]


@dataclass(frozen=True, slots=True)
class Placeholder:
    """Limits of one number in place of the URDF's, with the reason."""

    joint: str
    lower: float | None
    upper: float | None
    velocity: float | None
    reason: str


def placeholder_limits(joint: Joint) -> Placeholder | None:
    """Return the placeholder for unusable limits of a joint; None if the URDF's are usable."""
    reasons = [*_positions(joint), *_speeds(joint)]
    if not reasons:
        return None
    slides = joint.kind == "prismatic"
    way = _SLIDE if slides else _TURN
    speed = _SLIDING if slides else _SPEED
    bad_range, bad_speed = bool(_positions(joint)), bool(_speeds(joint))
    return Placeholder(
        joint.name,
        -way if bad_range else None,
        way if bad_range else None,
        speed if bad_speed else None,
        f"{' and '.join(reasons)}: a placeholder, verify it on the robot",
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
