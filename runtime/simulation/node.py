"""Simulated execution node: `python -m runtime.simulation.node --robot NAME`; uses the protocol of real nodes.

Each tick executes the newest command, moves the plant and publishes one observation. Beyond the plain protocol an
observation contains the frame number (`seq`), colour order (`encoding`), current master (`master`), number of the
master's last message that took effect (`ack`), refused messages by reason (`refused`), whether the robot is `holding`
because it receives no commands, and the state of its `drives`. With `--bench tabletop`, `contact` (the same with
contact forces), `conveyor`, or another bench by name or path there are objects; the word "scene_reset" resets them, and
the field `truth` is their ground truth.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np

from robots.broken_pipe import exit_on_broken_pipe
from runtime.benches.schema import installed_benches
from runtime.core import msgpack_arrays
from runtime.core.clock import Clock, MonotonicClock
from runtime.core.errors import RuntimeFault, SetupError
from runtime.core.node_sockets import Sockets
from runtime.core.types import Float64, UInt8
from runtime.simulation import environments, program
from runtime.simulation.bench.bench import BenchError
from runtime.simulation.bench.block_table import ResetRequest
from runtime.simulation.bench.plant import Plant, poses
from runtime.simulation.command_gate import AcceptedCommand, CommandGate
from runtime.simulation.drives import Drives
from runtime.simulation.scripts.gestures import Gesture

if TYPE_CHECKING:
    from threading import Event

    from robots import Robot
    from runtime.simulation.environment import Environment

LONGEST_STEP = 0.2  # [s] longest time step, so that a suspended node does not jump
_GARBAGE = b"\x85\xa1t"  # map of five entries, truncated within the first
_NO_LEADER = "the simulated node has no leader arm"


class Ticking(Protocol):
    """Interface of objects that `run` advances."""

    def tick(self, seconds: float) -> None:
        """Advance by `seconds`."""


class Node:
    """Simulated node of one robot with two sockets; call `open`, then `tick` at the rate, then `close`.

    To exchange messages without sockets, call `exchange` instead. If `around` is given, the robot is in this
    environment instead of the one that the options name.

    Raises:
        SetupError: If a camera or pose in the options does not exist.
    """

    def __init__(
        self, robot: Robot, options: argparse.Namespace, clock: Clock, around: Environment | None = None
    ) -> None:
        robot_cameras = [camera.key for camera in robot.cameras]
        for key in (options.freeze_camera, options.drop_camera):
            if key is not None and key not in robot_cameras:
                raise SetupError(f"{robot.name} has no camera {key!r}; it has {', '.join(robot_cameras)}")
        self._robot = robot
        self._options = options
        self._clock = clock
        self._plant = Plant(robot, start=start_pose(robot, options.start_pose))
        self._drives = Drives(not options.drives_disabled, options.drive_fault)
        self._gate = CommandGate(
            robot, options.deadline, bench=options.bench != "none", as_given=options.as_given
        )
        self._surroundings = around or environments.make_environment(robot, options)
        self._leader = Gesture(robot, options.seed) if robot.arms else None
        self._leader_phase: float | None = None  # of the leader's gesture; None unless it collects
        self._hil_error = ""
        self._unlaid: dict[str, str] = {}  # the last reset, if it was refused, and why
        self._frozen: UInt8 | None = None
        self._holding = True
        self._sequence = 0
        self._sockets: Sockets | None = None

    def open(self) -> dict[str, str]:
        """Bind both sockets and return their actual addresses."""
        options = self._options
        self._sockets = Sockets(options.obs_endpoint, options.action_endpoint, options.insecure_link)
        return self._sockets.addresses

    def tick(self, seconds: float) -> None:
        """Execute the received commands, move for `seconds`, and publish an observation."""
        assert self._sockets is not None
        self._sockets.publish(self.exchange(self._sockets.received(), seconds))

    def exchange(self, payloads: Sequence[bytes], seconds: float) -> bytes:
        """Execute received messages and move for `seconds`; return the packed observation to publish."""
        self._obey(payloads)
        self._move(seconds)
        every = self._options.malformed_every
        payload = msgpack_arrays.pack(self._observation())
        if every and self._sequence % every == every - 1:
            payload = _GARBAGE
        self._sequence += 1
        return payload

    def close(self) -> None:
        """Release the sockets; safe to call twice."""
        if self._sockets is not None:
            self._sockets.close()
        self._sockets = None
        self._surroundings.close()

    def _obey(self, payloads: Sequence[bytes]) -> None:
        """Filter the received messages and execute the accepted ones; of several targets only the newest takes
        effect.
        """
        newest = row = None
        for payload in payloads:
            accepted = self._gate.accept(payload, self._clock.now())
            if accepted is not None and accepted.control is not None:
                self._control(accepted)
            elif accepted is not None and accepted.reset is not None:
                self._reset_bench(accepted.reset)
            elif accepted is not None and accepted.switch is not None:
                self._drives.apply(accepted.switch)
            elif accepted is not None:
                newest = accepted.target
                row = newest if accepted.acting else None
        if newest is not None and self._leader_phase is not None:
            self._gate.refused["collecting"] += 1
        elif newest is not None:
            self._plant.target, self._plant.row = newest, row

    def _control(self, accepted: AcceptedCommand) -> None:
        """Execute a control word; it may be received several times, which has no further effect."""
        if accepted.control == "collect_start" and self._leader is None:
            self._gate.refused["no_leader"] += 1
        elif accepted.control == "collect_start" and self._leader is not None and self._leader_phase is None:
            self._leader_phase = self._leader.phase_of(self._plant.q)
        elif accepted.control == "collect_stop" and self._leader_phase is not None:
            self._leader_phase = None
            self._plant.hold()
        elif accepted.control == "hil_start":
            self._hil_error = _NO_LEADER
        elif accepted.control == "hil_stop":
            self._hil_error = ""

    def _reset_bench(self, wish: ResetRequest) -> None:
        try:
            self._surroundings.reset(wish)
        except BenchError as error:
            self._gate.refused["bench_layout"] += 1
            self._unlaid = {"id": wish.id, "why": str(error)}
        else:
            self._unlaid = {}

    def _move(self, seconds: float) -> None:
        silent = self._gate.is_silent(self._clock.now())
        if not self._drives.enabled:
            self._plant.hold()
        elif self._leader_phase is not None and self._leader is not None:
            self._leader_phase += self._leader.turn(seconds)
            self._plant.target = self._leader.towards(self._leader_phase, self._plant.target, seconds)
        elif silent and not self._holding:
            self._plant.hold()
        self._holding = silent and self._leader_phase is None
        self._surroundings.move(self._plant, seconds)

    def _observation(self) -> dict[str, object]:
        robot, q = self._robot, self._plant.q
        message: dict[str, object] = {
            "t": self._clock.now() + self._options.clock_offset,
            "images": self._pictures(),
            "state": {name: part.astype(np.float32) for name, part in robot.split(q).items()},
        }
        if robot.arms and not self._options.no_eef:
            message["eef"] = poses(robot, q)
        if self._leader_phase is not None:
            applied = self._plant.target
            message["action"] = applied.astype(np.float32)
            message["action_eef"] = np.concatenate([np.empty(0, np.float32), *poses(robot, applied).values()])
        message |= {"hil_supported": False, "hil_active": False}
        if self._hil_error:
            message["hil_error"] = self._hil_error
        message |= {"proto": 1, "seq": self._sequence, "encoding": "bgr", "holding": self._holding}
        message |= {"refused": dict(self._gate.refused), "master": self._gate.master or ""}
        message |= {} if self._gate.ack is None else {"ack": self._gate.ack}
        message["drives"] = self._drives.status()
        vector = self._surroundings.state_vector()
        message |= {} if vector is None else {"environment_state": vector}
        truth = self._surroundings.truth()
        if truth is not None and self._options.as_given:
            truth["benchmark"] = True
        if truth is not None and self._unlaid:
            truth["refused"] = dict(self._unlaid)
        return message if truth is None else message | {"truth": truth}

    def _pictures(self) -> dict[str, UInt8]:
        pictures = self._surroundings.pictures(self._sequence, self._clock.now(), self._plant.q)
        frozen = self._options.freeze_camera
        if frozen is not None:
            if self._frozen is None:
                self._frozen = pictures[frozen]
            pictures[frozen] = self._frozen
        pictures.pop(self._options.drop_camera, None)
        return pictures


def run(node: Ticking, clock: Clock, rate: float, told: Event) -> None:
    """Call `tick` at absolute deadlines until the event `told` is set; missed ticks are skipped.

    A tick that is late by less than half a period still runs at once, so that the next one is on time again.
    """
    period = 1.0 / rate
    due = last = clock.now()
    while not told.is_set():
        clock.sleep_until(due)
        now = clock.now()
        node.tick(min(now - last, LONGEST_STEP))
        last = now
        due += period * max(1, int((clock.now() - due) / period + 0.5))


def parser() -> argparse.ArgumentParser:
    """Return the command line's parser."""
    line = argparse.ArgumentParser(
        prog="python -m runtime.simulation.node", description="A simulated execution node."
    )
    line.add_argument("--robot", required=True, help="name of a folder in robots/, or a path")
    line.add_argument(
        "--groups", type=program.names, metavar="NAME,...", help="of the robot, as the deployment has them"
    )
    line.add_argument("--obs-endpoint", default="tcp://127.0.0.1:5555", help="port 0 takes a free one")
    line.add_argument("--action-endpoint", default="tcp://127.0.0.1:5556", help="port 0 takes a free one")
    line.add_argument("--insecure-link", action="store_true", help="allow addresses beyond this machine")
    line.add_argument("--rate", type=positive, default=30.0, help="observations per second")
    line.add_argument("--width", type=int, default=640)
    line.add_argument("--height", type=int, default=480)
    line.add_argument(
        "--deadline", type=positive, default=0.3, help="seconds without a command until it holds"
    )
    line.add_argument(
        "--seed", type=int, default=0, help="grain of the pictures, gestures of the leader, first layout"
    )
    line.add_argument(
        "--bench",
        default="none",
        help=f"what there is to touch: {', '.join(environments.OWN)} (default: none), or with contact forces "
        f"{', '.join(installed_benches())}, or the path of a bench's folder",
    )
    line.add_argument(
        "--as-given", action="store_true", help="targets beyond the robot's limits too, for a benchmark"
    )
    line.add_argument("--blocks", type=int, default=1, help="on the tabletop; the first is the task's")
    line.add_argument("--start-pose", metavar="NAME", default="home", help="a pose of the robot")
    line.add_argument(
        "--freeze-camera", metavar="KEY", help="fault: this camera sends its first picture forever"
    )
    line.add_argument("--drop-camera", metavar="KEY", help="fault: this camera is missing")
    line.add_argument(
        "--malformed-every", type=int, default=0, metavar="N", help="fault: each Nth message is cut"
    )
    line.add_argument(
        "--drive-fault",
        action="append",
        default=[],
        metavar="TEXT",
        help="fault: said of the drives, which are off",
    )
    line.add_argument("--drives-disabled", action="store_true", help="fault: the drives are off")
    line.add_argument("--no-eef", action="store_true", help="it measures no poses of its end effectors")
    line.add_argument(
        "--clock-offset", type=float, default=0.0, metavar="S", help="added to the node's clock"
    )
    program.add_arguments(line)
    return line


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Run a node until SIGTERM, SIGINT or the end of the lifeline."""
    import robots

    options = parser().parse_args(arguments)
    stop = program.stop_event(options.lifeline)
    clock = MonotonicClock()
    try:
        node = Node(robots.load_robot(options.robot, options.groups), options, clock)
        with contextlib.closing(node):
            program.announce_ready(node.open(), options.ready_file)
            run(node, clock, options.rate, stop)
    except (RuntimeFault, robots.RobotError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def start_pose(robot: Robot, name: str) -> Float64:
    """Return the joints [D] of the pose `name`.

    Raises:
        SetupError: If the robot has no such pose; the message lists its poses.
    """
    if name not in robot.poses:
        raise SetupError(f"{robot.name} has no pose {name!r}; it has {', '.join(robot.poses)}")
    return robot.poses[name]


def positive(text: str) -> float:
    """Parse a number of the command line that is above zero and below 1e6."""
    number = float(text)
    if not 0 < number < 1e6:
        raise argparse.ArgumentTypeError(f"{text} is not above zero and below 1,000,000")
    return number


if __name__ == "__main__":
    sys.exit(main())
