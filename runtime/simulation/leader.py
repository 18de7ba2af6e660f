"""Simulated leader: `python -m runtime.simulation.leader --robot NAME`; it replaces the leader arm that a person moves.

It subscribes to a simulated execution node and publishes over ZMQ the joints that the script of the tabletop task would
reach a moment later, as a person does who watches the bench and moves a leader arm. Its messages are those that
`runtime.teleoperators.zmq` reads.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import zmq

from robots.broken_pipe import exit_on_broken_pipe
from runtime.core import msgpack_arrays
from runtime.core.clock import Clock, MonotonicClock
from runtime.core.errors import RuntimeFault
from runtime.core.node_sockets import address, bound
from runtime.core.types import Float64
from runtime.simulation import program
from runtime.simulation.node import positive, run, start_pose
from runtime.simulation.scripts.pick_place import PickPlace, Skill
from runtime.simulation.scripts.script import Script, WavingScript
from runtime.teleoperators.base import Leader
from runtime.transports import zmq as node
from runtime.transports.node_source import NodeSource

if TYPE_CHECKING:
    from robots import Robot
    from runtime.core.types import Observation

_ASKS_S = 0.2  # [s] period at which the script plans anew; in between, its rows are followed
_HORIZON_S = 1.0
_AHEAD_S = 0.1  # [s] lead: a leader is ahead of the robot that follows it


class SimulatedLeader:
    """Leader whose joints come from a script: `start` [D] until the first observation, then the script's rows.

    `rate` is the rate of the script's rows [Hz].
    """

    def __init__(self, robot: Robot, script: Script, task: str, rate: float, start: Float64) -> None:
        self._robot, self._task, self._rate = robot, task, rate
        self._answer = script.begin()
        self._joints = start.copy()
        self._rows: Float64 | None = None
        self._asked = float("-inf")

    def update(self, observation: Observation, now: float) -> None:
        """Pass the observation at time `now` [s] to the script, and follow the rows that it returns from now on.

        Do nothing if the previous observation was passed to it less than _ASKS_S seconds ago.
        """
        if now - self._asked < _ASKS_S:
            return
        q = np.asarray(observation.qpos, np.float64)
        self._rows = np.asarray(self._answer(q, observation.pictures, self._task), np.float64)
        self._asked = now

    def joints_at(self, now: float) -> Float64:
        """Return the leader's joints [D] at time `now` [s], slightly ahead of the robot that follows."""
        if self._rows is not None:
            row = int((now - self._asked + _AHEAD_S) * self._rate)
            self._joints = self._rows[min(row, len(self._rows) - 1)]
        return self._joints

    def message(self, now: float) -> bytes:
        """Return the leader's message at time `now` [s], packed."""
        parts = self._robot.split(self.joints_at(now)).items()
        return msgpack_arrays.pack(
            {"t": now, "state": {name: part.astype(np.float32) for name, part in parts}}
        )


class AttachedLeader(Leader):
    """Simulated leader within the station's process, for lockstep; it reports its joints at each observation."""

    def __init__(self, robot: Robot, clock: Clock, simulated: SimulatedLeader) -> None:
        super().__init__(robot, clock)
        self._simulated = simulated

    @property
    def name(self) -> str:
        return "the simulated leader"

    def connect(self) -> None:
        """Do nothing, because there is no connection."""

    def update(self, observation: Observation) -> None:
        """Update the simulated leader from an observation, and publish its joints as its newest pose."""
        now = self._clock.now()
        self._simulated.update(observation, now)
        self._set_pose(self._simulated.joints_at(now), now)

    def close(self) -> None:
        """Do nothing, because there are no resources."""


def demonstrator(
    robot: Robot, task: str, seed: int, behaviour: str = "pick_place", start: str = "home"
) -> SimulatedLeader:
    """Return a simulated leader that performs `task`.

    If `behaviour` is "pick_place", it follows the pick-and-place script; with any other name it makes a gesture. Before
    the first observation the leader is at the pose `start`.

    Raises:
        SetupError: If the robot has no such pose, or no arm of it can pick objects up.
    """
    rate = robot.control_rate
    horizon = round(_HORIZON_S * rate)
    script: Script = WavingScript(robot, horizon, rate, seed)
    if behaviour == "pick_place":
        script = PickPlace(robot, horizon, rate, Skill(seed=seed))
    return SimulatedLeader(robot, script, task, rate, start_pose(robot, start))


class LeaderPublisher:
    """Publisher of a simulated leader; each `tick` reads the node's observation and sends one message."""

    def __init__(self, leader: SimulatedLeader, source: NodeSource, endpoint: str, clock: Clock) -> None:
        self._leader, self._source, self._clock = leader, source, clock
        self._socket = bound(zmq.PUB, endpoint, False)

    @property
    def address(self) -> str:
        """Bound address of the publisher."""
        return address(self._socket)

    def tick(self, seconds: float) -> None:
        """Update the leader from the node's newest observation if there is one, and publish its joints."""
        now = self._clock.now()
        observation = self._source.receive(0.0)
        if observation is not None:
            self._leader.update(observation, now)
        with contextlib.suppress(zmq.Again):  # dropped for a slow subscriber: the next message is newer
            self._socket.send(self._leader.message(now), zmq.NOBLOCK)

    def close(self) -> None:
        """Release the socket and the connection to the node."""
        self._socket.close(linger=0)
        self._source.close()


def parser() -> argparse.ArgumentParser:
    """Return the command line's parser."""
    line = argparse.ArgumentParser(
        prog="python -m runtime.simulation.leader", description="A simulated leader arm."
    )
    line.add_argument("--robot", required=True, help="name of a folder in robots/, or a path")
    line.add_argument(
        "--groups", type=program.names, metavar="NAME,...", help="of the robot, as the deployment has them"
    )
    line.add_argument(
        "--obs-endpoint", default="tcp://127.0.0.1:5555", help="where the simulated node publishes"
    )
    line.add_argument(
        "--endpoint", default="tcp://127.0.0.1:5560", help="where it publishes; port 0 takes a free one"
    )
    line.add_argument("--rate", type=positive, default=60.0, help="messages per second")
    line.add_argument("--behaviour", choices=["pick_place", "gesture"], default="pick_place")
    line.add_argument("--task", default="put the block on the plate", help="what the script is asked for")
    line.add_argument("--seed", type=int, default=0, help="of the script")
    line.add_argument(
        "--start-pose", metavar="NAME", default="home", help="where it is before the node is seen"
    )
    program.add_arguments(line)
    return line


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Run a leader until SIGTERM, SIGINT or the end of the lifeline."""
    import robots

    options = parser().parse_args(arguments)
    stop = program.stop_event(options.lifeline)
    clock = MonotonicClock()
    try:
        robot = robots.load_robot(options.robot, options.groups)
        source = node.source(node.Config(sub_endpoint=options.obs_endpoint, simulated=True), robot, clock)
        leader = demonstrator(robot, options.task, options.seed, options.behaviour, options.start_pose)
        publishing = LeaderPublisher(leader, source, options.endpoint, clock)
        with contextlib.closing(publishing):
            source.connect()
            program.announce_ready({"endpoint": publishing.address}, options.ready_file)
            run(publishing, clock, options.rate, stop)
    except (RuntimeFault, robots.RobotError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
