"""Keys of the XPolicyLab protocol for the arms of a robot, and the indices of their numbers in a row.

The keys of two arms begin with `left_` and `right_`, those of a single arm have no prefix. A pose is x, y, z [m] and a
unit quaternion w, x, y, z.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

from runtime.core.errors import ConfigurationError
from runtime.core.pose_format import PoseFormat
from runtime.core.types import ActionMode

if TYPE_CHECKING:
    from robots import Robot

Side = Literal["left", "right"]
Parts = dict[str, list[int]]
SINGLE_ARM_JOINTS = ("arm_joint_state", "joint_state")  # both names are in use
_POSE = 7  # x, y, z, qw, qx, qy, qz


def arm_prefixes(arms: Mapping[str, Side] | None, robot: Robot) -> list[str]:
    """Return the prefix of the keys of each of the robot's arms: "left_", "right_", or "" for a single arm.

    Arms that are not declared are told apart by their names, never by their order. Raises ConfigurationError if that is
    impossible, or the declaration does not fit the robot.
    """
    names = [arm.name for arm in robot.arms]
    if not 1 <= len(names) <= 2:
        raise ConfigurationError(
            f"{robot.name} has {len(names)} arms ({', '.join(names) or 'none'}) in this deployment; allowed for "
            "policy.kind = 'xpolicylab': one or two, chosen with groups"
        )
    if arms is None:
        if len(names) == 1:
            return [""]
        sides = [[side for side in ("left", "right") if name.startswith(side)] for name in names]
        if sorted(sides) != [["left"], ["right"]]:
            raise ConfigurationError(
                f"policy.arms is absent, and the names {', '.join(names)} do not tell which arm is left; allowed: "
                'policy.arms with "left" and "right" for each'
            )
        return [f"{side}_" for (side,) in sides]
    if set(arms) != set(names) or len(set(arms.values())) != len(arms):
        raise ConfigurationError(
            f"policy.arms = {dict(arms)}; allowed: each of {', '.join(names)} once, with different sides"
        )
    return [f"{arms[name]}_" for name in names]


def joint_parts(prefixes: list[str], robot: Robot, single: str) -> Parts:
    """Return the keys of joints and grippers, with the indices in the robot's vector.

    `single` is the name of the joints of a single arm without prefix.
    """
    parts: Parts = {}
    for prefix, arm in zip(prefixes, robot.arms, strict=True):
        parts[f"{prefix}arm_joint_state" if prefix else single] = arm.joint_dims.tolist()
        if arm.gripper_dim is not None:
            parts[f"{prefix}ee_joint_state"] = [arm.gripper_dim]
    return parts


def pose_parts(prefixes: list[str], robot: Robot, pose: PoseFormat, mode: ActionMode = "absolute") -> Parts:
    """Return the keys of poses and grippers, with the indices in a row of the format `pose`.

    Poses that are not absolute have keys of their own.
    """
    name = "ee_pose" if mode == "absolute" else "delta_ee_pose"
    each = _POSE + pose.gripper
    parts: Parts = {}
    for place, (prefix, arm) in enumerate(zip(prefixes, robot.arms, strict=True)):
        start = each * place
        parts[f"{prefix}{name}"] = list(range(start, start + _POSE))
        if pose.gripper and arm.gripper is not None:
            parts[f"{prefix}ee_joint_state"] = [start + _POSE]
    return parts


def require_arms_alone(robot: Robot) -> None:
    """Raise ConfigurationError if the robot has joints that belong to no arm: joint actions have no key for them."""
    arms = [arm.name for arm in robot.arms]
    others = [group.name for group in robot.groups if group.name not in arms]
    if others:
        raise ConfigurationError(
            f"policy.action_space = 'joint' has no key for {', '.join(others)} of {robot.name}; allowed: arms alone "
            f"(groups = {arms}), or the space 'eef', in which the others are held"
        )


def require_wire_pose(pose: PoseFormat, key: str) -> None:
    """Raise ConfigurationError if the protocol has no poses of this format; `key` names the deployment's table."""
    if pose.orientation != "wxyz" or pose.groups:
        raise ConfigurationError(
            f"{key} is {pose}; the protocol's poses are x, y, z, qw, qx, qy, qz; allowed: orientation = 'wxyz' and no "
            "groups"
        )
