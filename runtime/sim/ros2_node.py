"""A simulated robot behind its own ROS 2 topics: `python -m runtime.sim.ros2_node --robot NAME`.

A stand-in for the drivers of a robot, over DDS without a ROS installation: it says where its joints and what its
cameras see, and goes where it is told, as long as it is told. Topics are those of the robot's description, or for a
robot that has none /GROUP/joint_states, /GROUP/command and /CAMERA/image_raw/compressed.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from robots.description import RosGroupTable
from runtime.clock import Clock, MonotonicClock
from runtime.errors import RuntimeFault, SetupError
from runtime.sim import standin, surroundings
from runtime.sim.node import LONGEST_STEP, positive, run, start_pose
from runtime.sim.plant import Plant, poses
from runtime.types import UInt8

if TYPE_CHECKING:
    from robots import Group, Robot

_LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='false'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<MaxAutoParticipantIndex>30</MaxAutoParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers></Discovery>"
    "</Domain></CycloneDDS>"
)
_COMMANDS_TAKEN = 32


def topics(robot: Robot) -> tuple[dict[str, str], dict[str, RosGroupTable]]:
    """Camera topics by the camera's key, and the topics of each group."""
    own = robot.ros if robot.ros is not None and robot.ros.version == 2 else None
    if own is not None:
        pictures = {camera.key: own.cameras[camera.name] for camera in robot.cameras}
        return pictures, {group.name: own.groups[group.name] for group in robot.groups}
    pictures = {camera.key: f"/{camera.name}/image_raw/compressed" for camera in robot.cameras}
    return pictures, {
        group.name: RosGroupTable(state=f"/{group.name}/joint_states", command=f"/{group.name}/command")
        for group in robot.groups
    }


class Ros2Node:
    """One robot; `open`, then `tick` at the rate, then `close`."""

    def __init__(self, robot: Robot, options: argparse.Namespace, clock: Clock) -> None:
        self._robot, self._options, self._clock = robot, options, clock
        self._plant = Plant(robot, start=start_pose(robot, options.start_pose))
        self._surroundings = surroundings.surroundings(robot, options)
        self._pictures, self._groups = topics(robot)
        known = [*self._pictures.values(), *(group.state for group in self._groups.values())]
        if options.silence is not None and options.silence not in known:
            raise SetupError(f"--silence {options.silence} is no topic of {robot.name}; it has {known}")
        self._writers: dict[str, Any] = {}
        self._readers: list[tuple[list[int], tuple[str, ...], Any]] = []
        self._heard = -math.inf
        self._holding = True
        self._sequence = 0
        self._entities: list[Any] = []
        self.refused = 0  # commands with other names, or numbers that are none

    def open(self) -> dict[str, object]:
        """Join the domain, and return it with the topics of the pictures."""
        from cyclonedds.domain import Domain, DomainParticipant

        domain = self._options.domain
        self._entities = [Domain(domain, _LOOPBACK), DomainParticipant(domain)]
        for group in self._robot.groups:
            for outlet in _outlets(group, self._groups[group.name]):
                self._readers.append((*outlet[1:], self._reader(outlet[0])))
        return {"domain": domain, "cameras": self._pictures}

    def tick(self, seconds: float) -> None:
        """Obey, move for `seconds`, publish."""
        self._obey()
        silent = self._clock.now() - self._heard > self._options.deadline
        if silent and not self._holding:
            self._plant.hold()
        self._holding = silent
        self._surroundings.move(self._plant, min(seconds, LONGEST_STEP))
        self._publish()
        self._sequence += 1

    def truth(self) -> dict[str, object] | None:
        """What really lies on its bench."""
        return self._surroundings.truth()

    def close(self) -> None:
        """Leave the domain; safe to call twice."""
        for entity in reversed(self._entities):
            entity.__del__()  # with all that it has made, whoever still holds that
        self._entities, self._writers, self._readers = [], {}, []

    def _obey(self) -> None:
        for dims, names, reader in self._readers:
            for sample in reader.take(_COMMANDS_TAKEN):
                if not hasattr(sample, "position"):
                    continue  # a publisher has gone
                numbers = np.array(sample.position)
                fits = (
                    tuple(sample.name) == names and len(numbers) == len(dims) and np.isfinite(numbers).all()
                )
                if not fits:
                    self.refused += 1
                    continue
                self._plant.target[dims] = np.clip(numbers, self._robot.lower[dims], self._robot.upper[dims])
                self._heard = self._clock.now()

    def _publish(self) -> None:
        from runtime.sim import ros2_types as types

        stamp = divmod(time.time_ns() + int(self._options.clock_offset * 1e9), 10**9)
        header = types.Header(types.Time(*stamp))
        for group in self._robot.groups:
            topic = self._groups[group.name]
            for name, dims, joints in _states(group, topic):
                spoken = [f"x_{joint}" if self._options.wrong_names else joint for joint in joints]
                order = np.random.default_rng(self._sequence).permutation(len(dims))  # as drivers may
                position = self._plant.q[np.array(dims)[order]].tolist()
                self._say(name, types.JointState(header, [spoken[i] for i in order], position))
            if topic.eef and group.chain is not None and not self._options.no_eef:
                self._say(topic.eef, self._pose(header, group))
        for key, picture in self._surroundings.pictures(
            self._sequence, self._clock.now(), self._plant.q
        ).items():
            self._say(self._pictures[key], self._picture(header, self._pictures[key], picture))

    def _pose(self, header: Any, arm: Group) -> Any:
        from runtime.sim import ros2_types as types

        x, y, z, qw, qx, qy, qz = poses(self._robot, self._plant.q)[arm.name][:7].tolist()
        framed = types.Header(header.stamp, arm.frame or "")
        return types.PoseStamped(framed, types.Pose(types.Point(x, y, z), types.Quaternion(qx, qy, qz, qw)))

    def _picture(self, header: Any, topic: str, bgr: UInt8) -> Any:
        import simplejpeg

        from runtime.sim import ros2_types as types

        height, width = bgr.shape[:2]
        if topic.endswith("/compressed") and not self._options.raw_pictures:
            data = simplejpeg.encode_jpeg(np.ascontiguousarray(bgr), 90, "BGR")
            return types.CompressedImage(header, "bgr8; jpeg compressed bgr8", data)
        encoding = self._options.encoding
        return types.Image(header, height, width, encoding, 0, 3 * width, bgr.tobytes())

    def _say(self, topic: str, message: Any) -> None:
        if topic == self._options.silence and self._sequence >= self._options.silence_from:
            return
        if topic not in self._writers:
            self._writers[topic] = self._writer(topic, type(message))
        self._writers[topic].write(message)

    def _writer(self, topic: str, kind: Any) -> Any:
        from cyclonedds.pub import DataWriter
        from cyclonedds.qos import Policy, Qos
        from cyclonedds.topic import Topic

        how = Policy.Reliability.BestEffort
        channel = Topic(self._entities[1], f"rt{topic}", kind)
        return DataWriter(self._entities[1], channel, Qos(how, Policy.History.KeepLast(10)))

    def _reader(self, topic: str) -> Any:
        """As a driver with ROS 2's default quality of service: reliable, which hears no best-effort commands."""
        from cyclonedds.qos import Policy, Qos
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic
        from cyclonedds.util import duration

        from runtime.sim import ros2_types as types

        how = Policy.Reliability.Reliable(duration(milliseconds=100))
        channel = Topic(self._entities[1], f"rt{topic}", types.JointState)
        return DataReader(self._entities[1], channel, Qos(how, Policy.History.KeepLast(10)))


def _states(group: Group, topic: RosGroupTable) -> Iterator[tuple[str, list[int], tuple[str, ...]]]:
    """Topic, places in the robot's vector and joint names of what says where the group is."""
    return _split(group, topic.state, topic.gripper_state)


def _outlets(group: Group, topic: RosGroupTable) -> Iterator[tuple[str, list[int], tuple[str, ...]]]:
    """The same of what tells it where to go."""
    return _split(group, topic.command, topic.gripper_command)


def _split(
    group: Group, whole: str | None, hand: str | None
) -> Iterator[tuple[str, list[int], tuple[str, ...]]]:
    dims, joints = list(range(group.slice.start, group.slice.stop)), group.joints
    if hand and group.gripper is not None:
        place = group.gripper.index
        yield hand, dims[place : place + 1], joints[place : place + 1]
        dims, joints = dims[:place] + dims[place + 1 :], joints[:place] + joints[place + 1 :]
    if whole:
        yield whole, dims, joints


def parser() -> argparse.ArgumentParser:
    """The command line."""
    line = argparse.ArgumentParser(
        prog="python -m runtime.sim.ros2_node", description="A simulated robot behind ROS 2 topics."
    )
    line.add_argument("--robot", required=True, help="name of a folder in robots/, or a path")
    line.add_argument("--groups", type=standin.names, metavar="NAME,...", help="of the robot")
    line.add_argument("--domain", type=int, default=0, help="ROS_DOMAIN_ID; on loopback alone")
    line.add_argument("--rate", type=positive, default=30.0, help="of everything, per second")
    line.add_argument("--width", type=int, default=640)
    line.add_argument("--height", type=int, default=480)
    line.add_argument(
        "--deadline", type=positive, default=0.3, help="seconds without a command until it holds"
    )
    line.add_argument("--seed", type=int, default=0, help="grain of the pictures, first layout")
    line.add_argument("--bench", choices=surroundings.NAMES, default="none", help="what there is to touch")
    line.add_argument("--blocks", type=int, default=1, help="on the tabletop; the first is the task's")
    line.add_argument("--start-pose", metavar="NAME", default="home", help="a pose of the robot")
    line.add_argument("--no-eef", action="store_true", help="it publishes no poses of its end effectors")
    line.add_argument("--raw-pictures", action="store_true", help="Image whatever the topic's name says")
    line.add_argument("--encoding", default="bgr8", help="said of raw pictures, which are bgr8")
    line.add_argument("--wrong-names", action="store_true", help="fault: joints have other names")
    line.add_argument("--silence", metavar="TOPIC", help="fault: nothing is published there")
    line.add_argument("--silence-from", type=int, default=0, metavar="N", help="fault: from this tick on")
    line.add_argument("--clock-offset", type=float, default=0.0, metavar="S", help="added to its clock")
    standin.add_arguments(line)
    return line


def main(arguments: Sequence[str] | None = None) -> int:
    """Run until SIGTERM, SIGINT or the end of the lifeline; then print the truth of the bench as JSON."""
    import robots

    options = parser().parse_args(arguments)
    told = standin.ending(options.lifeline)
    clock = MonotonicClock()
    try:
        node = Ros2Node(robots.load(options.robot, options.groups), options, clock)
        with contextlib.closing(node):
            standin.announce(node.open(), options.ready_file)
            run(node, clock, options.rate, told)
            print(json.dumps({"truth": node.truth(), "refused": node.refused}), flush=True)
    except ImportError as error:
        print(f'{error}: install it: pip install "eva-web[ros2]"', file=sys.stderr)
        return 2
    except (RuntimeFault, robots.RobotError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
