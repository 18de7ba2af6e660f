"""python -m robots: lists the robots, checks a description, answers forward kinematics."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence

import numpy as np

from robots import Robot, RobotError, load, names
from robots.clearance import problems


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; returns 0, or 1 where the description or the question is wrong."""
    options = _parser().parse_args(arguments)
    try:
        if options.command == "list":
            print("\n".join(f"{name}  {load(name).title}" for name in names()))
        elif options.command == "check":
            return _check(load(options.name))
        else:
            print(json.dumps(_forward(load(options.name), options.group, options.q)))
    except RobotError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m robots", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="the robots that come with the program")
    check = commands.add_parser("check", help="load a robot and show what it declares")
    check.add_argument("name", metavar="NAME", help="a robot's name or a folder")
    fk = commands.add_parser("fk", help="where joints put a group's end effector, as JSON")
    fk.add_argument("name", metavar="NAME", help="a robot's name or a folder")
    fk.add_argument("group", metavar="GROUP")
    fk.add_argument(
        "q", metavar="Q", type=float, nargs=argparse.REMAINDER, help="joints [rad], without the gripper"
    )
    return parser


def _check(robot: Robot) -> int:
    print("\n".join(_summary(robot)))
    found = problems(robot)
    for sentence in found:
        print(f"{robot.folder}: {sentence}", file=sys.stderr)
    return 1 if found else 0


def _summary(robot: Robot) -> list[str]:
    lines = [f"{robot.name}: {robot.title}, {robot.dim} numbers, {robot.control_rate:g} Hz"]
    lines.append(f"cameras: {', '.join(f'{camera.name} -> {camera.key}' for camera in robot.cameras)}")
    lines.append(f"limits: {robot.limits_source}")
    lines += [f"  override: {sentence}" for sentence in robot.overrides]
    home = robot.poses["home"]
    for index, name in enumerate(robot.joint_names):
        low, high = robot.lower[index], robot.upper[index]
        note = "  home is on a limit" if home[index] in (low, high) else ""
        lines.append(f"  {name:24} {low:9.4f} to {high:9.4f}, at most {robot.velocity[index]:g}/s{note}")
    for arm in robot.arms:
        pose = [f"{value:.5f}" for value in arm.pose(home)]
        place = f"position {', '.join(pose[:3])} m, wxyz {', '.join(pose[3:])}"
        lines.append(f"{arm.name}: {arm.eef_link} in {arm.frame} at home: {place}")
    return lines


def _forward(robot: Robot, name: str, q: list[float]) -> dict[str, object]:
    group = robot.group(name)
    if group.chain is None:
        raise RobotError(
            f"{robot.name}: {name} has no end effector; arms: {', '.join(a.name for a in robot.arms)}"
        )
    if len(q) != group.chain.size or not np.isfinite(q).all():
        raise RobotError(
            f"{name} was given {q}; needed: {group.chain.size} finite numbers, {', '.join(group.urdf_joints)}"
        )
    joints = robot.poses["home"].copy()  # what carries the arm stands as at home
    joints[group.joint_dims] = q
    pose = group.pose(joints)
    own = joints[group.joint_dims]
    low, high = robot.lower[group.joint_dims], robot.upper[group.joint_dims]
    return {
        "position": pose[:3].tolist(),
        "wxyz": pose[3:].tolist(),
        "frame": group.frame,
        "link": group.eef_link,
        "within_limits": bool(((own >= low) & (own <= high)).all()),
    }


if __name__ == "__main__":
    sys.exit(main())
