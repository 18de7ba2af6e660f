"""Syntax of the command line of `python -m runtime.ctl`: one subcommand per command."""

from __future__ import annotations

import argparse
import json
import math
import os
from collections.abc import Sequence
from typing import Any, get_args

from runtime.core.types import Result
from runtime.ipc.messages import Mode
from runtime.ipc.session_state import SessionState

# States of a station, and phases of a run in progress.
WORDS = (
    *SessionState,
    *("asking", "executing", "waiting", "proposed", "moving", "approaching", "starved"),
)
_TRIPLES = (
    "--xyz",
    "--rpy",
    "--joints",
)  # their numbers may start with a minus, which argparse would parse as an option

_PRESSED = "pressed in a terminal"


def parse(words: Sequence[str]) -> argparse.Namespace:
    """Parse the command line; end the process with exit code 2 and a message if it is invalid.

    An e-stop press with invalid further options still counts as a press; the message is printed as well.
    """
    try:
        return _strictly(words)
    except SystemExit as end:
        press = _press(words) if end.code else None
        if press is None:
            raise
        return press


def _press(arguments: Sequence[str]) -> argparse.Namespace | None:
    """Return the press of the e-stop in an invalid command line, None if there is none.

    STATION and estop may come in either order.
    """
    positional, data_dir = [], _data_dir()
    left = iter(arguments)
    for word in left:
        if word == "--data-dir":
            data_dir = next(left, data_dir)
        elif word.startswith("--data-dir="):
            data_dir = word.partition("=")[2]
        elif not word.startswith("-"):
            positional.append(word)
    if "estop" not in positional[:2] or len(positional) < 2:
        return None
    station = positional[0] if positional[1] == "estop" else positional[1]
    reason = " ".join(positional[2:]) or _PRESSED
    return argparse.Namespace(
        data_dir=data_dir, station=station, command="estop", why=reason, json="--json" in arguments
    )


def _strictly(arguments: Sequence[str]) -> argparse.Namespace:
    top, commands = _parser()
    parsed, unknown = top.parse_known_args(_joined(arguments))
    if unknown:
        command = commands[parsed.command]
        options = sorted(
            o for action in command._actions for o in action.option_strings if o.startswith("--")
        )
        command.error(f"{parsed.command} does not take {' '.join(unknown)}; it takes {', '.join(options)}")
    _check(parsed, commands[parsed.command])
    return parsed


def _data_dir() -> str:
    return os.environ.get("EVA_DATA_DIR") or "data"


def _joined(arguments: Sequence[str]) -> list[str]:
    joined: list[str] = []
    for word in arguments:
        if joined and joined[-1] in _TRIPLES:
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def _parser() -> tuple[argparse.ArgumentParser, dict[str, argparse.ArgumentParser]]:
    top = argparse.ArgumentParser(
        prog="python -m runtime.ctl",
        description="Commands and watches a station from a terminal.",
        epilog="exit codes: 0 done, 1 refused or failed, 2 misspelt, 3 no answer in time: outcome unknown, 130 Ctrl-C",
        allow_abbrev=False,
    )
    top.add_argument("--data-dir", default=_data_dir(), help="where stations lie")
    top.add_argument("station")
    commands: dict[str, argparse.ArgumentParser] = {}
    lines = top.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, (says, takes) in _COMMANDS.items():
        line = lines.add_parser(name, help=says, description=says, allow_abbrev=False)
        line.add_argument("--data-dir", default=argparse.SUPPRESS, help="where stations lie")
        line.add_argument("--json", action="store_true", help="say the outcome as JSON")
        takes(line)
        commands[name] = line
    return top, commands


def _check(options: argparse.Namespace, command: argparse.ArgumentParser) -> None:
    """Check the combinations of options of `command` that argparse cannot check."""
    if options.command == "tune" and not (
        options.show or options.strategy or options.set or options.task is not None
    ):
        command.error("tune needs --strategy, --set, --task or --show")
    if options.command == "setup" and options.cancel and _setup_says_more(options):
        command.error("setup --cancel takes nothing else")
    if options.command == "jog" and options.xyz is None and options.rpy is None:
        command.error("jog needs --xyz, --rpy or both")


def _setup_says_more(options: argparse.Namespace) -> bool:
    values = (
        options.policy_url,
        options.policy,
        options.strategy,
        options.task,
        options.checkpoint,
        options.bench_seed,
        options.collect,
    )
    return any(value is not None for value in values)


# --- options of each command -------------------------------------------------------------------------------


def _nothing(line: argparse.ArgumentParser) -> None:
    pass


def _setup(line: argparse.ArgumentParser) -> None:
    line.add_argument("--policy-url", metavar="URL", help="another server than the deployment's")
    line.add_argument("--policy", type=_setting, nargs="+", action="extend", metavar="KEY=VALUE")
    line.add_argument("--strategy", metavar="KIND", help="another strategy than the deployment's")
    line.add_argument("--task", metavar="TEXT", help="another instruction than the deployment's")
    line.add_argument("--checkpoint", metavar="NAME", help="which one is behind the policy, for the manifest")
    line.add_argument("--bench-seed", type=int, metavar="N", help="lay a simulated bench out anew")
    line.add_argument(
        "--collect",
        action="store_true",
        default=None,
        help="a person drives, as the deployment's [collection] says",
    )
    line.add_argument("--cancel", action="store_true", help="end the set-up that goes on")


def _run(line: argparse.ArgumentParser) -> None:
    line.add_argument("--mode", choices=get_args(Mode), help="else the deployment's")
    line.add_argument(
        "--sim-state", choices=["live", "simulated"], help="what the policy sees in the mode sim"
    )
    line.add_argument("--duration", type=_finite, metavar="S", help="seconds after which it ends by itself")
    line.add_argument("--operator", metavar="NAME", help="who runs it, for the manifest")
    line.add_argument("--task", metavar="TEXT", help="what this demonstration is of (mode collect)")
    line.add_argument("--arm", action="store_true", help="arm first, under the same lease (mode collect)")


def _waits(line: argparse.ArgumentParser) -> None:
    line.add_argument("--wait", action="store_true", help="until it is over, and say how it went")


def _target(line: argparse.ArgumentParser, *more: str) -> Any:
    """Add the mutually exclusive options that name a target, and return their group.

    The caller may add further options to the group.
    """
    group = line.add_mutually_exclusive_group(required=True)
    group.add_argument("--pose", metavar="NAME", help="a pose of the robot")
    group.add_argument(
        "--joints", type=_numbers, metavar="A,B,...", help="all joints [rad, or the gripper's unit]"
    )
    group.add_argument(
        "--joint",
        type=_joint,
        nargs="+",
        action="extend",
        metavar="NAME=VALUE",
        help="these joints, the others as commanded; NAME+=VALUE and NAME-=VALUE from where it is commanded",
    )
    return group


def _step_of_an_arm(line: argparse.ArgumentParser) -> None:
    line.add_argument("--xyz", type=_triple, metavar="MM,MM,MM", help="along the axes of the frame")
    line.add_argument("--rpy", type=_triple, metavar="DEG,DEG,DEG", help="roll, pitch, yaw about them")
    line.add_argument("--frame", choices=["base", "tool"], default="base", help="whose axes (default: base)")


def _speed(line: argparse.ArgumentParser) -> None:
    line.add_argument("--speed", type=_finite, metavar="PART", help="of the speed of such motions, up to 1")


def _move(line: argparse.ArgumentParser) -> None:
    _target(line)
    _speed(line)
    _waits(line)


def _jog(line: argparse.ArgumentParser) -> None:
    line.add_argument("arm")
    _step_of_an_arm(line)
    _speed(line)
    _waits(line)
    line.add_argument("--nearest", action="store_true", help="go as near as it can where it cannot go there")


def _aim(line: argparse.ArgumentParser) -> None:
    _target(line).add_argument("--arm", help="a step of this arm, as by jog")
    _step_of_an_arm(line)


def _gripper(line: argparse.ArgumentParser) -> None:
    line.add_argument("action", choices=["open", "close", "lock", "unlock"])
    line.add_argument("--arm", help="this one alone")
    _waits(line)


def _tune(line: argparse.ArgumentParser) -> None:
    line.add_argument("--strategy", metavar="KIND", help="another strategy")
    line.add_argument("--set", type=_setting, nargs="+", action="extend", metavar="KEY=VALUE")
    line.add_argument("--task", metavar="TEXT", help="another instruction")
    line.add_argument("--show", action="store_true", help="what is in force")


def _record(line: argparse.ArgumentParser) -> None:
    line.add_argument("what", choices=["start", "stop"])


def _episode(line: argparse.ArgumentParser) -> None:
    line.add_argument("--episode", metavar="UUID", help="another than the open or the newest one")


def _label(line: argparse.ArgumentParser) -> None:
    line.add_argument("result", choices=get_args(Result))
    line.add_argument("--note", metavar="TEXT")
    _episode(line)


def _estop(line: argparse.ArgumentParser) -> None:
    line.add_argument("why", nargs="?", default=_PRESSED)


def _wait(line: argparse.ArgumentParser) -> None:
    line.add_argument("what", choices=WORDS, help="a state, or a phase of a run")
    line.add_argument("--timeout", type=_finite, default=30.0, metavar="S", help="at most (default: 30)")


def _events(line: argparse.ArgumentParser) -> None:
    line.add_argument("--since", type=int, default=0, metavar="N", help="those after event N")
    line.add_argument("--last", type=int, metavar="N", help="the newest N of them")
    line.add_argument("--kind", nargs="+", action="extend", metavar="KIND", help="of these kinds alone")


_COMMANDS = {
    "setup": ("connect the policy, home, warm up, check an answer", _setup),
    "run": ("open a run and attend it", _run),
    "step": ("ask for one chunk (modes step, preview)", _waits),
    "commit": ("execute the chunk that is shown (mode preview)", _waits),
    "cancel": ("forget the chunk that is shown, end a motion (modes step, preview, manual)", _waits),
    "move": ("go to joints or to a pose (mode manual)", _move),
    "jog": ("move an end effector by a step (mode manual)", _jog),
    "aim": ("say where it would go, and move nothing", _aim),
    "gripper": ("open, close, lock or unlock grippers", _gripper),
    "tune": ("another strategy, other parameters, another instruction, also while it runs", _tune),
    "approach": ("go to the policy's first action on a limited path", _waits),
    "home": ("drive to the pose of the set-up", _nothing),
    "stop": ("decelerate, hold, close the run; while setting up: cancel", _nothing),
    "halt": ("decelerate and hold; the run stays open", _nothing),
    "resume": ("go on with the run that is held, and attend it", _nothing),
    "release": ("unlatch the e-stop", _nothing),
    "estop": ("the software e-stop; needs no lease", _estop),
    "arm": ("switch on that a demonstration may begin; falls with the lease, so see run --arm", _nothing),
    "disarm": ("switch it off", _nothing),
    "label": ("say how a demonstration went", _label),
    "discard": ("mark a demonstration as never to be published; the open one ends", _episode),
    "record": ("an episode without a policy", _record),
    "status": ("how the station is", _nothing),
    "wait": ("until the station is in a state, or its run in a phase", _wait),
    "watch": ("figures and events as they come", _nothing),
    "events": ("what has happened", _events),
}


# --- values ------------------------------------------------------------------------------------------------


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"{text} was given; allowed: finite numbers")
    return number


def _numbers(text: str) -> list[float]:
    return [_finite(part) for part in text.split(",")]


def _triple(text: str) -> list[float]:
    numbers = _numbers(text)
    if len(numbers) != 3:
        raise argparse.ArgumentTypeError(f"{text} has {len(numbers)} numbers; allowed: three, as 10,0,-5")
    return numbers


def _joint(text: str) -> tuple[str, str, float]:
    """Parse a joint's target into (name, "=" or "+" or "-", value)."""
    name, separator, value = text.partition("=")
    how = name[-1:] if name[-1:] in ("+", "-") else ""
    name = name[: len(name) - len(how)]
    if not (separator and name):
        raise argparse.ArgumentTypeError(f"{text} was given; allowed: NAME=VALUE, NAME+=VALUE, NAME-=VALUE")
    return name, how or "=", _finite(value)


def _setting(text: str) -> tuple[str, Any]:
    """Parse a setting into (key, value): JSON if valid, else text; "none" becomes None."""
    key, separator, value = text.partition("=")
    if not (separator and key):
        raise argparse.ArgumentTypeError(f"{text} was given; allowed: KEY=VALUE")
    if value == "none":
        return key, None
    try:
        return key, json.loads(value, parse_constant=_no_constant)
    except ValueError:
        return key, value


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} is no JSON")
