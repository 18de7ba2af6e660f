"""Simulated robot with its own ROS 2 topics: `python -m runtime.simulation.ros2_node --robot NAME`.

It replaces the drivers of a robot, over DDS without a ROS installation: it publishes joints and camera images and
follows commands until they stop for longer than the deadline. Topics are those of the robot's description; for a robot
without them /GROUP/joint_states, /GROUP/command and /CAMERA/image_raw/compressed.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from robots.broken_pipe import exit_on_broken_pipe
from runtime.core.clock import Clock, MonotonicClock
from runtime.core.errors import RuntimeFault
from runtime.core.types import UInt8
from runtime.simulation import program
from runtime.simulation.node import run
from runtime.simulation.ros import ros_robot
from runtime.simulation.ros.ros_robot import JointTopic, ReceivedCommand, RosRobot

if TYPE_CHECKING:
    from robots import Robot

_LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='false'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<MaxAutoParticipantIndex>30</MaxAutoParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers></Discovery>"
    "</Domain></CycloneDDS>"
)
_COMMANDS_TAKEN = 32  # samples per topic and tick


class Ros2Node(RosRobot):
    """ROS 2 node of one simulated robot; call `open`, then `tick` at the rate, then `close`."""

    VERSION = 2

    def __init__(self, robot: Robot, options: argparse.Namespace, clock: Clock) -> None:
        super().__init__(robot, options, clock)
        self._writers: dict[str, Any] = {}
        self._readers: list[tuple[JointTopic, Any]] = []
        self._entities: list[Any] = []

    def open(self) -> dict[str, object]:
        """Join the DDS domain; return its id and the image topics."""
        from cyclonedds.domain import Domain, DomainParticipant

        domain = self._options.domain
        self._entities = [Domain(domain, _LOOPBACK), DomainParticipant(domain)]
        self._readers = [(outlet, self._reader(outlet.topic)) for outlet in self.outlets()]
        return {"domain": domain, "cameras": self._pictures}

    def close(self) -> None:
        """Leave the domain; safe to call twice."""
        for entity in reversed(self._entities):
            entity.__del__()  # deletes its children too, even if they are still referenced
        self._entities, self._writers, self._readers = [], {}, []

    def _received_commands(self) -> Iterator[ReceivedCommand]:
        for outlet, reader in self._readers:
            for sample in reader.take(_COMMANDS_TAKEN):
                if hasattr(sample, "position"):  # otherwise the sample reports that a publisher has left
                    yield ReceivedCommand(outlet, tuple(sample.name), sample.position)

    def _publish_joints(self, topic: str, stamp: int, names: list[str], position: list[float]) -> None:
        from runtime.simulation.ros import ros2_types as types

        self._publish_message(topic, types.JointState(_header(stamp), names, position))

    def _publish_pose(self, topic: str, stamp: int, frame: str, pose: list[float]) -> None:
        from runtime.simulation.ros import ros2_types as types

        x, y, z, qw, qx, qy, qz = pose
        placed = types.Pose(types.Point(x, y, z), types.Quaternion(qx, qy, qz, qw))
        self._publish_message(topic, types.PoseStamped(_header(stamp, frame), placed))

    def _publish_image(self, topic: str, stamp: int, encoding: str, pixels: UInt8) -> None:
        from runtime.simulation.ros import ros2_types as types

        height, width = pixels.shape[:2]
        image = types.Image(_header(stamp), height, width, encoding, 0, 3 * width, pixels.tobytes())
        self._publish_message(topic, image)

    def _publish_compressed(self, topic: str, stamp: int, data: bytes) -> None:
        from runtime.simulation.ros import ros2_types as types

        self._publish_message(
            topic, types.CompressedImage(_header(stamp), "bgr8; jpeg compressed bgr8", data)
        )

    def _publish_message(self, topic: str, message: Any) -> None:
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
        """Return a reader of commands with the default QoS of ROS 2 drivers.

        The reader is reliable. As with real drivers, it therefore receives nothing from a best-effort publisher.
        """
        from cyclonedds.qos import Policy, Qos
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic
        from cyclonedds.util import duration

        from runtime.simulation.ros import ros2_types as types

        how = Policy.Reliability.Reliable(duration(milliseconds=100))
        channel = Topic(self._entities[1], f"rt{topic}", types.JointState)
        return DataReader(self._entities[1], channel, Qos(how, Policy.History.KeepLast(10)))


def _header(stamp: int, frame: str = "") -> Any:
    from runtime.simulation.ros import ros2_types as types

    return types.Header(types.Time(*divmod(stamp, 10**9)), frame)


def parser() -> argparse.ArgumentParser:
    """Return the command line's parser."""
    line = argparse.ArgumentParser(
        prog="python -m runtime.simulation.ros2_node", description="A simulated robot behind ROS 2 topics."
    )
    line.add_argument("--domain", type=int, default=0, help="ROS_DOMAIN_ID; on loopback alone")
    ros_robot.add_arguments(line)
    return line


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until SIGTERM, SIGINT or the end of the lifeline; then print the ground truth of the bench
    as JSON.
    """
    import robots

    options = parser().parse_args(arguments)
    stop = program.stop_event(options.lifeline)
    clock = MonotonicClock()
    try:
        node = Ros2Node(robots.load_robot(options.robot, options.groups), options, clock)
        with contextlib.closing(node):
            program.announce_ready(node.open(), options.ready_file)
            run(node, clock, options.rate, stop)
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
