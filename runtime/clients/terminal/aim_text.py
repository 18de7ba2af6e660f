"""Targets of the robot at the terminal: joints from the command line, and descriptions for the operator."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from typing import Any

from runtime.clients.client import StationClient
from runtime.core.errors import RuntimeFault

_STILL = 5e-4  # smallest change of a joint that is printed [rad, or the gripper's unit]


def aim_arguments(client: StationClient, given: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments of `aim` from the command line `given`. Raises: RuntimeFault if there is no such joint."""
    arm = getattr(given, "arm", None)
    if arm is not None:
        return {"jog": _jog(given, arm)}
    if given.pose is not None:
        return {"pose": given.pose}
    if given.joints is not None:
        return {"joints": given.joints}
    status = client.status()
    commanded = client.query("aim").data["joints"]
    return {"joints": _changed(status["facts"]["joint_names"], commanded, given.joint)}


def _jog(options: argparse.Namespace, arm: str) -> dict[str, Any]:
    millimetres, degrees = options.xyz or [0.0] * 3, options.rpy or [0.0] * 3
    return {
        "arm": arm,
        "frame": options.frame,
        "translation": [part / 1000 for part in millimetres],
        "rotation": [math.radians(part) for part in degrees],
    }


def _changed(
    names: Sequence[str], commanded: Sequence[float], changes: Sequence[tuple[str, str, float]]
) -> list[float]:
    joints = dict(zip(names, commanded, strict=True))
    for name, how, value in changes:
        if name not in joints:
            raise RuntimeFault(f"joint {name!r} is none of the robot's; it has {', '.join(names)}")
        joints[name] = {"=": value, "+": joints[name] + value, "-": joints[name] - value}[how]
    return list(joints.values())


def aim_lines(
    aim: Mapping[str, Any], commanded: Sequence[float], names: Sequence[str], speed: float
) -> list[str]:
    """Describe an answer to `aim`: each joint that would move, distance, duration, and deviations from the request.

    Args:
        aim: Answer of the station.
        commanded: Commanded joints [D].
        names: Names of the joints [D].
        speed: Speed of the motion as a share of the speed that the answer assumes, at most 1.
    """
    lines = [
        f"  {name:<24} {now:+.4f} -> {then:+.4f}"
        for name, now, then in zip(names, commanded, aim["joints"], strict=True)
        if abs(then - now) >= _STILL
    ]
    lines = lines or ["  no joint would move"]
    lines.append(f"  at most {aim['distance']:.3f} rad, in up to {aim['duration_s'] / speed:.1f} s")
    short = aim_problem(aim)
    return [*lines, f"  NOT AS ASKED: {short}"] if short else lines


def aim_problem(aim: Mapping[str, Any]) -> str:
    """Return how the target in the answer `aim` differs from the request, "" if it does not."""
    parts = []
    if aim["clipped"]:
        parts.append(f"stopped by the limits of {', '.join(aim['clipped'])}")
    if not aim["reached"]:
        error = f"{aim['position_error_mm']:.1f} mm and {aim['rotation_error_deg']:.1f} degrees"
        parts.append(f"{error} away from the pose")
    return "; ".join(parts)
