"""Stand-in policy servers: `python -m runtime.standins.serve openpi --robot NAME`; one module per protocol."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Protocol

from robots.broken_pipe import exit_on_broken_pipe
from runtime.core.errors import RuntimeFault, SetupError
from runtime.simulation import program
from runtime.simulation.scripts.script import Script, WavingScript
from runtime.standins import faults

if TYPE_CHECKING:
    from robots import Robot
    from runtime.core.clock import Clock
    from runtime.standins.rtc_wires import Name


class StandInServer(Protocol):
    """Interface of stand-in servers: `start` listens and returns the address, `close` stops."""

    def start(self) -> dict[str, object]: ...

    def close(self) -> None: ...


def parser() -> argparse.ArgumentParser:
    """Return the command line's parser."""
    line = argparse.ArgumentParser(
        prog="python -m runtime.standins.serve",
        description="A stand-in policy server.",
        epilog="faults: " + "; ".join(f"{name}: {text}" for name, text in faults.NAMES.items()),
    )
    line.add_argument("protocol", choices=list(_PROTOCOLS))
    line.add_argument("--robot", required=True, help="name of a folder in robots/, or a path")
    line.add_argument(
        "--groups", type=program.names, metavar="NAME,...", help="of the robot, as the deployment has them"
    )
    line.add_argument("--port", type=int, default=8000, help="0 takes a free one")
    line.add_argument("--horizon", type=int, default=50, help="rows per chunk")
    line.add_argument("--rate", type=float, help="rows per second; the robot's control rate if not given")
    line.add_argument(
        "--latency-ms", "--delay-ms", type=float, default=0.0, help="time that an inference takes"
    )
    line.add_argument("--behaviour", choices=["gesture", "pick_place", "sorting", "chase"], default="gesture")
    line.add_argument("--name", help="what the server calls its policy; the behaviour's own if not given")
    line.add_argument(
        "--seed", type=int, default=0, help="which gesture; the chances of pick_place and sorting"
    )
    line.add_argument(
        "--bench",
        default="sorting",
        help="sorting: bench with the blocks and bins, by name or path of its folder",
    )
    skill = line.add_argument_group("how good pick_place and sorting are")
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
        choices=["none", "prev_action", "openpi_rtc", "kai0", "async_rtc"],
        help="openpi: how it is told what the robot is committed to, which it then copies: prev_action's flat keys "
        "(plain requests are understood too; the default), the dialects of openpi-rtc or kai0, versioned envelopes "
        "alone, or not at all, as always with --space eef",
    )
    arena = line.add_argument_group("roboarena and vllm")
    arena.add_argument(
        "--reply", choices=["dict", "bare", "parts"], default="dict", help="form of its answers"
    )
    arena.add_argument("--velocity", action="store_true", help="joint velocities instead of positions")
    arena.add_argument("--resolution", type=_resolution, default=(224, 224), metavar="HxW", help="or none")
    arena.add_argument("--externals", type=int, choices=[0, 1, 2], default=1, help="exterior views it wants")
    arena.add_argument("--numbering", type=int, choices=[0, 1], default=0, help="of the first exterior view")
    arena.add_argument("--no-session", action="store_true", help="it wants no session id")
    arena.add_argument("--idle", type=float, metavar="S", help="leaves a silent client; vllm after 30 s")
    groot = line.add_argument_group("gr00t")
    groot.add_argument(
        "--version",
        choices=["n1.5", "n1.6", "n1.7", "n1.7-early", "starvla"],
        default="n1.6",
        help="of the server; starvla: StarVLA's server of this protocol",
    )
    groot.add_argument(
        "--use-sim-policy-wrapper",
        action="store_true",
        help="flat keys, as its own server's option of this name",
    )
    groot.add_argument("--token-env", metavar="NAME", help="environment variable with the API token it wants")
    lab = line.add_argument_group("xpolicylab")
    lab.add_argument(
        "--single-arm-joints",
        choices=["arm_joint_state", "joint_state"],
        default="arm_joint_state",
        help="how it calls the joints of a single arm",
    )
    line.add_argument("--fault", type=faults.parse, default=faults.NONE, metavar="NAME[:ARG]")
    program.add_arguments(line)
    return line


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Run a stand-in server until SIGTERM, SIGINT or the end of the lifeline."""
    import robots

    options = parser().parse_args(arguments)
    stop = program.stop_event(options.lifeline)
    try:
        with contextlib.closing(build_server(options)) as server:
            program.announce_ready(server.start(), options.ready_file)
            stop.wait()
    except (RuntimeFault, robots.RobotError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def build_server(options: argparse.Namespace, clock: Clock | None = None) -> StandInServer:
    """Return the server that a command line describes, not yet started.

    With a virtual `clock` the server answers at once: the station's policy.delay_ms is its latency, in every protocol.

    Raises:
        RuntimeFault: If an option is invalid.
        RobotError: If the robot cannot be loaded.
    """
    import robots

    if clock is not None and options.latency_ms:
        raise SetupError(
            f"--latency-ms {options.latency_ms:g} in lockstep, where real time does not count; allowed: 0, and "
            "policy.delay_ms in the deployment or the checkpoint"
        )
    robot = robots.load_robot(options.robot, options.groups)
    rate = options.rate or robot.control_rate
    played = _spoken(_script(robot, rate, options, clock), robot, rate, options)
    return _PROTOCOLS[options.protocol](robot, rate, played, options)


def _openpi(robot: Robot, rate: float, script: Script, options: argparse.Namespace) -> StandInServer:
    from runtime.standins.openpi_server import Behaviour, OpenpiServer

    latency = options.latency_ms / 1e3
    behaviour = Behaviour(options.horizon, rate, latency, options.fault, options.seed, _rtc(options))
    return OpenpiServer(robot, behaviour, options.port, script)


def _gr00t(robot: Robot, rate: float, script: Script, options: argparse.Namespace) -> StandInServer:
    from runtime.standins.gr00t_server import Gr00tBehaviour, Gr00tServer

    token = os.environ.get(options.token_env, "") if options.token_env else ""
    if options.token_env and not token:
        raise SetupError(f"--token-env {options.token_env}: it is not set in the environment")
    behaviour = Gr00tBehaviour(
        options.version,
        options.use_sim_policy_wrapper,
        options.horizon,
        rate,
        options.latency_ms / 1e3,
        options.fault,
        options.seed,
        token,
    )
    return Gr00tServer(robot, behaviour, options.port, script)


def _roboarena(robot: Robot, rate: float, script: Script, options: argparse.Namespace) -> StandInServer:
    from runtime.standins.roboarena_server import RoboarenaBehaviour, RoboarenaServer

    arena = RoboarenaBehaviour(
        options.horizon,
        rate,
        options.latency_ms / 1e3,
        options.fault,
        options.seed,
        variant=options.protocol,
        reply=options.reply,
        resolution=options.resolution,
        externals=options.externals,
        session=not options.no_session,
        space="joint_velocity" if options.velocity else "joint_position",
        numbering=options.numbering,
        idle=options.idle,
    )
    return RoboarenaServer(robot, arena, options.port, script)


def _starvla(robot: Robot, rate: float, script: Script, options: argparse.Namespace) -> StandInServer:
    from runtime.standins.starvla_server import StarvlaBehaviour, StarvlaServer

    star = StarvlaBehaviour(options.horizon, rate, options.latency_ms / 1e3, options.fault, options.seed)
    return StarvlaServer(robot, star, options.port, script)


def _xpolicylab(robot: Robot, rate: float, script: Script, options: argparse.Namespace) -> StandInServer:
    from runtime.standins.xpolicylab_server import XpolicylabBehaviour, XpolicylabServer

    latency = options.latency_ms / 1e3
    lab = XpolicylabBehaviour(
        options.horizon, rate, latency, options.fault, options.seed, single=options.single_arm_joints
    )
    return XpolicylabServer(robot, lab, options.port, script)


def _lerobot(robot: Robot, rate: float, script: Script, options: argparse.Namespace) -> StandInServer:
    try:
        from runtime.standins.lerobot_server import LerobotBehaviour, LerobotServer
    except ImportError as error:
        raise SetupError(
            f"lerobot needs grpcio and protobuf: pip install 'eva-web[lerobot-grpc]' ({error})"
        ) from error
    latency = options.latency_ms / 1e3
    behaviour = LerobotBehaviour(options.horizon, rate, latency, options.fault, options.seed)
    return LerobotServer(robot, behaviour, options.port, script)


_PROTOCOLS: dict[str, Callable[[Robot, float, Script, argparse.Namespace], StandInServer]] = {
    "openpi": _openpi,
    "gr00t": _gr00t,
    "lerobot": _lerobot,
    "roboarena": _roboarena,
    "vllm": _roboarena,
    "starvla": _starvla,
    "xpolicylab": _xpolicylab,
}


def _rtc(options: argparse.Namespace) -> Name:
    """Return the name of the server's RTC format.

    Raises:
        SetupError: If the server could not continue a chunk.
    """
    if options.space == "eef" and options.rtc not in (None, "none"):
        raise SetupError(
            f"--rtc {options.rtc} with --space eef: it continues joint rows alone; allowed: none"
        )
    chosen: Name = options.rtc or ("none" if options.space == "eef" else "prev_action")
    return chosen


def _spoken(script: Script, robot: Robot, rate: float, options: argparse.Namespace) -> Script:
    """Return the script, wrapped so that it answers in poses if the options request that."""
    if options.space == "joint":
        if options.pose:
            raise SetupError(f"--pose {' '.join(options.pose)}: allowed with --space eef")
        return script
    from runtime.simulation.scripts.pose_script import PoseScript, pose_format

    return PoseScript(script, robot, rate, pose_format(options.pose))


def _script(robot: Robot, rate: float, options: argparse.Namespace, clock: Clock | None) -> Script:
    from runtime.simulation.scripts.chase import ChaseScript
    from runtime.simulation.scripts.pick_place import PickPlace, Skill, poses_apart

    if options.behaviour not in ("pick_place", "sorting") and (options.noise or options.failure_rate):
        raise SetupError(
            "--noise and --failure-rate are for --behaviour pick_place and sorting; no other fails on purpose"
        )
    if options.behaviour == "chase":
        return ChaseScript(robot, options.horizon, rate, options.name, clock)
    if options.behaviour == "gesture":
        return WavingScript(robot, options.horizon, rate, options.seed, options.name)
    skill = Skill(options.noise / 1e3, options.failure_rate, options.seed)
    apart = poses_apart if options.space == "eef" else None
    if options.behaviour == "sorting":
        from runtime.benches.schema import load_schema
        from runtime.simulation.bench.bench import Bench
        from runtime.simulation.scripts.sorting import Sorting

        table = Bench(load_schema(options.bench))
        return Sorting(robot, options.horizon, rate, skill, table, options.name, clock, apart)
    return PickPlace(robot, options.horizon, rate, skill, options.name, clock, apart)


def _length(text: str) -> float:
    """Return the length [mm] that `text` states; it must be from 0 to 100."""
    return _number(text, 100.0)


def _share(text: str) -> float:
    """Parse a probability."""
    return _number(text, 1.0)


def _resolution(text: str) -> tuple[int, int] | None:
    """Parse height and width; return None for "none"."""
    if text == "none":
        return None
    height, _, width = text.partition("x")
    return int(height), int(width)


def _number(text: str, highest: float) -> float:
    number = float(text)
    if not 0 <= number <= highest:
        raise argparse.ArgumentTypeError(f"{text} was given; allowed: 0 to {highest:g}")
    return number


if __name__ == "__main__":
    sys.exit(main())
