"""Simulated robot with its own ROS 1 topics: `python -m runtime.simulation.ros1_node --robot NAME`.

It replaces the drivers of a robot, with rospy and its own messages; a ROS master has to run. It publishes joints and
camera images and follows commands until they stop for longer than the deadline. Topics are those of the robot's
description. If the description names none, they are /GROUP/joint_states, /GROUP/command and
/CAMERA/image_raw/compressed.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import tempfile
import xmlrpc.client
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robots.broken_pipe import exit_on_broken_pipe
from runtime.core.clock import Clock, MonotonicClock
from runtime.core.errors import RuntimeFault, SetupError
from runtime.core.types import UInt8
from runtime.simulation import program
from runtime.simulation.node import run
from runtime.simulation.ros import ros1_modules, ros_robot
from runtime.simulation.ros.ros_robot import ReceivedCommand, RosRobot

if TYPE_CHECKING:
    from robots import Robot

_COMMANDS_KEPT = 32  # newest commands between two ticks
_QUEUE = 10  # messages per topic
_LOGGING = "version: 1\ndisable_existing_loggers: false\n"


class Ros1Node(RosRobot):
    """ROS 1 node of one simulated robot; call `open`, then `tick` at the rate, then `close`.

    A process can open only one.
    """

    VERSION = 1

    def __init__(self, robot: Robot, options: argparse.Namespace, clock: Clock) -> None:
        super().__init__(robot, options, clock)
        self._publishers: dict[str, Any] = {}
        self._inbox: deque[ReceivedCommand] = deque(maxlen=_COMMANDS_KEPT)

    def open(self) -> dict[str, object]:
        """Register with the master; return its address, the node's name and the image topics.

        Raises:
            SetupError: If no master runs at the address.
        """
        master = self._options.master
        try:  # rospy itself would wait for the master for ever
            xmlrpc.client.ServerProxy(master).getPid("/sim")
        except OSError as error:
            raise SetupError(f"no ROS master is at {master}: {error}; start roscore") from error
        os.environ.pop("ROS_HOSTNAME", None)
        os.environ.update(ROS_MASTER_URI=master, ROS_IP="127.0.0.1")
        import rospy
        from sensor_msgs.msg import JointState

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "logging.yaml"
            path.write_text(_LOGGING)
            os.environ.update(ROS_PYTHON_LOG_CONFIG_FILE=str(path), ROS_LOG_DIR=folder)
            rospy.init_node(self._options.name, argv=[], disable_signals=True, disable_rosout=True)
        for outlet in self.outlets():
            rospy.Subscriber(outlet.topic, JointState, self._taker(outlet), queue_size=_QUEUE)
        return {"master": master, "node": rospy.get_name(), "cameras": self._pictures}

    def close(self) -> None:
        """Unregister from the master; safe to call twice."""
        import rospy

        rospy.signal_shutdown("the end")
        self._publishers = {}

    def _taker(self, outlet: ros_robot.JointTopic) -> Any:
        return lambda message: self._inbox.append(
            ReceivedCommand(outlet, tuple(message.name), list(message.position))
        )

    def _received_commands(self) -> Iterator[ReceivedCommand]:
        while self._inbox:
            yield self._inbox.popleft()

    def _publish_joints(self, topic: str, stamp: int, names: list[str], position: list[float]) -> None:
        from sensor_msgs.msg import JointState

        self._publish_message(topic, JointState(_header(stamp), names, position, [], []))

    def _publish_pose(self, topic: str, stamp: int, frame: str, pose: list[float]) -> None:
        from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion

        x, y, z, qw, qx, qy, qz = pose
        placed = Pose(Point(x, y, z), Quaternion(qx, qy, qz, qw))
        self._publish_message(topic, PoseStamped(_header(stamp, frame), placed))

    def _publish_image(self, topic: str, stamp: int, encoding: str, pixels: UInt8) -> None:
        from sensor_msgs.msg import Image

        height, width = pixels.shape[:2]
        self._publish_message(
            topic, Image(_header(stamp), height, width, encoding, 0, 3 * width, pixels.tobytes())
        )

    def _publish_compressed(self, topic: str, stamp: int, data: bytes) -> None:
        from sensor_msgs.msg import CompressedImage

        self._publish_message(topic, CompressedImage(_header(stamp), "bgr8; jpeg compressed bgr8", data))

    def _publish_message(self, topic: str, message: Any) -> None:
        import rospy

        if topic not in self._publishers:
            self._publishers[topic] = rospy.Publisher(topic, type(message), queue_size=_QUEUE)
        self._publishers[topic].publish(message)


def _header(stamp: int, frame: str = "") -> Any:
    import rospy
    from std_msgs.msg import Header

    return Header(0, rospy.Time(*divmod(stamp, 10**9)), frame)


def parser() -> argparse.ArgumentParser:
    """Return the command line's parser."""
    line = argparse.ArgumentParser(
        prog="python -m runtime.simulation.ros1_node", description="A simulated robot behind ROS 1 topics."
    )
    line.add_argument("--master", default="http://127.0.0.1:11311", help="ROS_MASTER_URI")
    line.add_argument("--python", default="/usr/bin/python3", help="the one whose rospy is taken")
    line.add_argument("--name", default="sim_robot", help="of the node")
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
        node = Ros1Node(robots.load_robot(options.robot, options.groups), options, clock)
        with ros1_modules.lent(options.python), contextlib.closing(node):
            program.announce_ready(node.open(), options.ready_file)
            run(node, clock, options.rate, stop)
            print(json.dumps({"truth": node.truth(), "refused": node.refused}), flush=True)
    except (RuntimeFault, robots.RobotError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
