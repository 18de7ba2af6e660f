"""Stand-in policy servers: `python -m runtime.sim.serve openpi --robot NAME`; one file per protocol."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from runtime.errors import RuntimeFault, SetupError
from runtime.sim import faults, standin
from runtime.sim.script import Script, Waving

if TYPE_CHECKING:
    from robots import Robot
    from runtime.sim.rtc_wires import Name


def parser() -> argparse.ArgumentParser:
    """The command line."""
    line = argparse.ArgumentParser(
        prog="python -m runtime.sim.serve",
        description="A stand-in policy server.",
        epilog="faults: " + "; ".join(f"{name}: {text}" for name, text in faults.NAMES.items()),
    )
    line.add_argument("protocol", choices=["openpi"])
    line.add_argument("--robot", required=True, help="name of a folder in robots/, or a path")
    line.add_argument(
        "--groups", type=standin.names, metavar="NAME,...", help="of the robot, as the deployment has them"
    )
    line.add_argument("--port", type=int, default=8000, help="0 takes a free one")
    line.add_argument("--horizon", type=int, default=50, help="rows per chunk")
    line.add_argument("--rate", type=float, help="rows per second; the robot's control rate if not given")
    line.add_argument(
        "--latency-ms", "--delay-ms", type=float, default=0.0, help="time that an inference takes"
    )
    line.add_argument("--behaviour", choices=["gesture", "pick_place", "chase"], default="gesture")
    line.add_argument("--name", help="what the server calls its policy; the behaviour's own if not given")
    line.add_argument("--seed", type=int, default=0, help="which gesture; the chances of pick_place")
    skill = line.add_argument_group("how good pick_place is")
    skill.add_argument(
        "--noise", type=_length, default=0.0, metavar="MM", help="one sigma on where it takes the block to be"
    )
    skill.add_argument(
        "--failure-rate", type=_share, default=0.0, metavar="P", help="share of episodes that it spoils"
    )
    poses = line.add_argument_group("what its rows are")
    poses.add_argument(
        "--space", choices=["joint", "eef"], default="joint", help="it is asked with joints in any case"
    )
    poses.add_argument(
        "--pose",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="with --space eef: how poses are written, the keys of policy.action_pose",
    )
    line.add_argument(
        "--rtc",
        choices=["none", "prev_action", "async_rtc"],
        help="how it is told what the robot is committed to, which it then copies: flat keys (plain requests are "
        "understood too; the default), envelopes alone, or not at all, as always with --space eef",
    )
    line.add_argument("--fault", type=faults.parse, default=faults.NONE, metavar="NAME[:ARG]")
    standin.add_arguments(line)
    return line


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve until SIGTERM, SIGINT or the end of the lifeline."""
    import robots
    from runtime.sim.openpi_server import Behaviour, OpenpiServer

    options = parser().parse_args(arguments)
    told = standin.ending(options.lifeline)
    try:
        robot = robots.load(options.robot, options.groups)
        rate = options.rate or robot.control_rate
        behaviour = Behaviour(
            options.horizon, rate, options.latency_ms / 1e3, options.fault, options.seed, _rtc(options)
        )
        played = _spoken(_script(robot, rate, options), robot, rate, options)
        with contextlib.closing(OpenpiServer(robot, behaviour, options.port, played)) as server:
            standin.announce(server.start(), options.ready_file)
            told.wait()
    except (RuntimeFault, robots.RobotError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _rtc(options: argparse.Namespace) -> Name:
    """How it is told what to continue; SetupError where it could not."""
    if options.space == "eef" and options.rtc not in (None, "none"):
        raise SetupError(
            f"--rtc {options.rtc} with --space eef: it continues joint rows alone; allowed: none"
        )
    chosen: Name = options.rtc or ("none" if options.space == "eef" else "prev_action")
    return chosen


def _spoken(script: Script, robot: Robot, rate: float, options: argparse.Namespace) -> Script:
    """The script, in the space that was asked for."""
    if options.space == "joint":
        if options.pose:
            raise SetupError(f"--pose {' '.join(options.pose)}: allowed with --space eef")
        return script
    from runtime.sim.in_poses import InPoses, pose_format

    return InPoses(script, robot, rate, pose_format(options.pose))


def _script(robot: Robot, rate: float, options: argparse.Namespace) -> Script:
    from runtime.sim.chase import Chase
    from runtime.sim.pick_place import PickPlace, Skill, poses_apart

    if options.behaviour != "pick_place" and (options.noise or options.failure_rate):
        raise SetupError(
            "--noise and --failure-rate are for --behaviour pick_place; no other fails on purpose"
        )
    if options.behaviour == "chase":
        return Chase(robot, options.horizon, rate, options.name)
    if options.behaviour == "gesture":
        return Waving(robot, options.horizon, rate, options.seed, options.name)
    skill = Skill(options.noise / 1e3, options.failure_rate, options.seed)
    apart = poses_apart if options.space == "eef" else None
    return PickPlace(robot, options.horizon, rate, skill, options.name, apart=apart)


def _length(text: str) -> float:
    """Millimetres from 0 to 100."""
    return _number(text, 100.0)


def _share(text: str) -> float:
    """A probability."""
    return _number(text, 1.0)


def _number(text: str, highest: float) -> float:
    number = float(text)
    if not 0 <= number <= highest:
        raise argparse.ArgumentTypeError(f"{text} was given; allowed: 0 to {highest:g}")
    return number


if __name__ == "__main__":
    sys.exit(main())
