"""python -m robots: lists the robots, checks a description, computes forward kinematics, drafts a description."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from robots import Robot, RobotError, description, load_robot, robot_names
from robots.broken_pipe import exit_on_broken_pipe
from robots.draft import draft_robot
from robots.inspection import Inspection, inspect_robot
from robots.loading import robot_folders


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return 0, or 1 if a description or an argument is wrong."""
    options = _parser().parse_args(arguments)
    try:
        return int(options.run(options))
    except RobotError as error:
        print(error, file=sys.stderr)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m robots", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    listing = commands.add_parser(
        "list", help="the robots that come with the program and those of $EVA_ROBOTS"
    )
    listing.set_defaults(run=_list)
    check = commands.add_parser("check", help="load a robot, say what it declares and what is wrong with it")
    check.add_argument("name", metavar="NAME", help="a robot's name or a folder")
    check.set_defaults(run=_check)
    fk = commands.add_parser("fk", help="where joints put a group's end effector, as JSON")
    fk.add_argument("name", metavar="NAME", help="a robot's name or a folder")
    fk.add_argument("group", metavar="GROUP")
    fk.add_argument(
        "q", metavar="Q", type=float, nargs=argparse.REMAINDER, help="joints [rad], without the gripper"
    )
    fk.set_defaults(run=_fk)
    new = commands.add_parser("new", help="draft a robot's folder from a URDF, with every guess marked")
    new.add_argument("name", metavar="NAME", help="small letters, digits and _")
    new.add_argument("--urdf", type=Path, required=True, metavar="FILE")
    new.add_argument(
        "--into", type=Path, metavar="FOLDER", help="default: the first of $EVA_ROBOTS, else here"
    )
    new.add_argument(
        "--copies", type=int, default=1, metavar="N", help="of the one arm in the URDF, side by side"
    )
    new.set_defaults(run=_new)
    return parser


def _list(_: argparse.Namespace) -> int:
    """Print the name and title of every robot; return 1 if one of them cannot be loaded."""
    broken = 0
    for name in robot_names():
        try:
            robot = load_robot(name)
        except RobotError as error:
            broken += 1
            print(f"{name}  cannot be loaded: {error}", file=sys.stderr)
        else:
            is_own = robot.folder.parent == Path(__file__).resolve().parent
            print(f"{name}  {robot.title}" + ("" if is_own else f"  ({robot.folder})"))
    return 1 if broken else 0


def _check(options: argparse.Namespace) -> int:
    return _print_findings(inspect_robot(options.name))


def _print_findings(inspection: Inspection) -> int:
    print("\n".join(inspection.lines))
    print("\n".join(f"warning: {sentence}" for sentence in inspection.warnings) or "no warnings")
    for sentence in inspection.errors:
        print(f"error: {sentence}", file=sys.stderr)
    return 1 if inspection.errors else 0


def _with_group(name: str, group: str) -> Robot:
    """Return the robot with its usual groups, and with `group` even if it is optional."""
    robot = load_robot(name)
    declared = description.read(robot.folder / "robot.toml").groups
    if group not in [entry.name for entry in declared if entry.optional]:
        return robot
    return load_robot(name, [*(usual.name for usual in robot.groups), group])


def _fk(options: argparse.Namespace) -> int:
    robot, q = _with_group(options.name, options.group), options.q
    group = robot.group(options.group)
    if group.chain is None:
        raise RobotError(
            f"{robot.name}: {group.name} has no end effector; arms: {', '.join(a.name for a in robot.arms)}"
        )
    if len(q) != group.chain.size or not np.isfinite(q).all():
        raise RobotError(
            f"{group.name} was given {q}; needed: {group.chain.size} finite numbers, {', '.join(group.urdf_joints)}"
        )
    joints = robot.poses["home"].copy()  # joints that carry the arm are as in the home pose
    joints[group.joint_dims] = q
    pose = group.pose(joints)
    own = joints[group.joint_dims]
    low, high = robot.lower[group.joint_dims], robot.upper[group.joint_dims]
    answer = {
        "position": pose[:3].tolist(),
        "wxyz": pose[3:].tolist(),
        "frame": group.frame,
        "link": group.eef_link,
        "within_limits": bool(((own >= low) & (own <= high)).all()),
    }
    print(json.dumps(answer))
    return 0


def _new(options: argparse.Namespace) -> int:
    """Draft a robot, then print the findings of `check` on the draft, and the next steps."""
    into = options.into or next(iter(robot_folders()), Path())
    drafted = draft_robot(options.name, options.urdf, into, options.copies)
    exit_code = _print_findings(drafted.inspection)
    if missing := drafted.pictures.missing:
        print(
            f"shapes: {len(missing)} meshes were not found or cannot be read, {missing[0]} the first; put them where"
        )
        print(
            "  the URDF says they are and draft again, or as LINK.stl into the robot's folder of $EVA_ROBOT_MESHES"
        )
    if drawn := drafted.pictures.drawn:
        print(f"shapes: cylinders from joint to joint stand in for {', '.join(drawn)}")
    print(f"drafted: {drafted.folder}")
    if options.name not in robot_names():
        print(f"found by name once EVA_ROBOTS={into.resolve()} is set; until then by its folder")
    print(
        f"next: verify what {drafted.folder / 'README.md'} lists, edit robot.toml, "
        f"python -m robots check {options.name}"
    )
    return exit_code


if __name__ == "__main__":
    sys.exit(main())
