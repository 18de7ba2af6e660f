"""Simulated robot with ROS topics, common to ROS 1 and 2: publishes joints, poses and images, and follows commands."""

from __future__ import annotations

import argparse
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, ClassVar, Literal, NamedTuple

import numpy as np

from robots.description import RosGroupTable
from runtime.core.clock import Clock
from runtime.core.errors import SetupError
from runtime.core.types import UInt8
from runtime.simulation import environments, program
from runtime.simulation.bench.plant import Plant, poses
from runtime.simulation.node import LONGEST_STEP, positive, start_pose

if TYPE_CHECKING:
    from robots import Group, Robot


class JointTopic(NamedTuple):
    """Topic of joint values: its name, the joints' dimensions in the robot's vector, and their names in messages."""

    topic: str
    dims: list[int]
    joints: tuple[str, ...]


class ReceivedCommand(NamedTuple):
    """Received command message: its topic, joint names and positions."""

    outlet: JointTopic
    names: tuple[str, ...]
    position: list[float]


def topics(robot: Robot, version: Literal[1, 2]) -> tuple[dict[str, str], dict[str, RosGroupTable]]:
    """Return the cameras' topics by camera key, and the topics of each group.

    They are those of the robot's description if it declares topics for this ROS version, else default names.
    """
    own = robot.ros if robot.ros is not None and robot.ros.version == version else None
    if own is not None:
        pictures = {camera.key: own.cameras[camera.name] for camera in robot.cameras}
        return pictures, {group.name: own.groups[group.name] for group in robot.groups}
    pictures = {camera.key: f"/{camera.name}/image_raw/compressed" for camera in robot.cameras}
    return pictures, {
        group.name: RosGroupTable(state=f"/{group.name}/joint_states", command=f"/{group.name}/command")
        for group in robot.groups
    }


class RosRobot(ABC):
    """Simulated robot as a ROS node; call `open`, then `tick` at the rate, then `close`.

    Raises:
        SetupError: If --silence names a topic that the robot does not have, or the start pose does not exist.
    """

    VERSION: ClassVar[Literal[1, 2]]

    def __init__(self, robot: Robot, options: argparse.Namespace, clock: Clock) -> None:
        self._robot, self._options, self._clock = robot, options, clock
        self._plant = Plant(robot, start=start_pose(robot, options.start_pose))
        self._surroundings = environments.make_environment(robot, options)
        self._pictures, self._groups = topics(robot, options.topics_of or self.VERSION)
        allowed = [*self._pictures.values(), *(group.state for group in self._groups.values())]
        if options.silence is not None and options.silence not in allowed:
            raise SetupError(f"--silence {options.silence} is no topic of {robot.name}; it has {allowed}")
        self._heard = -math.inf
        self._holding = True
        self._sequence = 0
        self.refused = 0  # commands with other joint names, or with missing or non-finite numbers

    @abstractmethod
    def open(self) -> dict[str, object]:
        """Start the node; return its address in ROS and the image topics."""

    @abstractmethod
    def close(self) -> None:
        """Stop the node; safe to call twice."""

    @abstractmethod
    def _received_commands(self) -> Iterable[ReceivedCommand]:
        """Return the commands received since the last tick."""

    @abstractmethod
    def _publish_joints(self, topic: str, stamp: int, names: list[str], position: list[float]) -> None:
        """Publish a sensor_msgs/JointState with a stamp [ns]."""

    @abstractmethod
    def _publish_pose(self, topic: str, stamp: int, frame: str, pose: list[float]) -> None:
        """Publish a geometry_msgs/PoseStamped of x, y, z [m], quaternion w, x, y, z."""

    @abstractmethod
    def _publish_image(self, topic: str, stamp: int, encoding: str, pixels: UInt8) -> None:
        """Publish a sensor_msgs/Image of uint8 [H, W, 3]."""

    @abstractmethod
    def _publish_compressed(self, topic: str, stamp: int, data: bytes) -> None:
        """Publish a sensor_msgs/CompressedImage of a JPEG."""

    def tick(self, seconds: float) -> None:
        """Execute the received commands, move for `seconds`, and publish."""
        self._obey()
        silent = self._clock.now() - self._heard > self._options.deadline
        if silent and not self._holding:
            self._plant.hold()
        self._holding = silent
        self._surroundings.move(self._plant, min(seconds, LONGEST_STEP))
        self._publish()
        self._sequence += 1

    def truth(self) -> dict[str, object] | None:
        """Return the ground truth of the bench; None if there is no bench."""
        return self._surroundings.truth()

    def outlets(self) -> Iterator[JointTopic]:
        """Yield the topics on which the robot receives commands: those for simulation if the options select them."""
        for group in self._robot.groups:
            topic = self._groups[group.name]
            if self._options.as_simulation:
                yield from _split(group, topic.simulation, None)
            else:
                yield from _split(group, topic.command, topic.gripper_command)

    def _obey(self) -> None:
        for outlet, names, position in self._received_commands():
            numbers = np.array(position)
            fits = names == outlet.joints and len(numbers) == len(outlet.dims) and np.isfinite(numbers).all()
            if not fits:
                self.refused += 1
                continue
            dims = outlet.dims
            self._plant.target[dims] = np.clip(numbers, self._robot.lower[dims], self._robot.upper[dims])
            self._heard = self._clock.now()

    def _publish(self) -> None:
        stamp = time.time_ns() + int(self._options.clock_offset * 1e9)
        for group in self._robot.groups:
            topic = self._groups[group.name]
            for name, dims, joints in _split(group, topic.state, topic.gripper_state):
                if self._silent(name):
                    continue
                spoken = [f"x_{joint}" if self._options.wrong_names else joint for joint in joints]
                order = np.random.default_rng(self._sequence).permutation(len(dims))  # as with real drivers
                position = self._plant.q[np.array(dims)[order]].tolist()
                self._publish_joints(name, stamp, [spoken[i] for i in order], position)
            if topic.eef and group.chain is not None and not self._options.no_eef:
                pose = poses(self._robot, self._plant.q)[group.name][:7].tolist()
                self._publish_pose(topic.eef, stamp, group.frame or "", pose)
        drawn = self._surroundings.pictures(self._sequence, self._clock.now(), self._plant.q)
        for key, picture in drawn.items():
            if not self._silent(self._pictures[key]):
                self._show(self._pictures[key], stamp, picture)

    def _show(self, topic: str, stamp: int, bgr: UInt8) -> None:
        import simplejpeg

        if topic.endswith("/compressed") == self._options.other_pictures:
            self._publish_image(topic, stamp, self._options.encoding, bgr)
        else:
            data = simplejpeg.encode_jpeg(np.ascontiguousarray(bgr), 90, "BGR")
            self._publish_compressed(topic, stamp, data)

    def _silent(self, topic: str) -> bool:
        return bool(topic == self._options.silence and self._sequence >= self._options.silence_from)


def _split(group: Group, whole: str | None, hand: str | None) -> Iterator[JointTopic]:
    """Yield the topics of a group's joints.

    `whole` is the topic of the group, None if it has none. `hand` is the topic of its gripper; if it is None, the
    gripper is one of the joints on the topic `whole`.
    """
    dims, joints = list(range(group.slice.start, group.slice.stop)), group.joints
    if hand and group.gripper is not None:
        place = group.gripper.index
        yield JointTopic(hand, dims[place : place + 1], joints[place : place + 1])
        dims, joints = dims[:place] + dims[place + 1 :], joints[:place] + joints[place + 1 :]
    if whole:
        yield JointTopic(whole, dims, joints)


def add_arguments(line: argparse.ArgumentParser) -> None:
    """Add the options that robots of both ROS versions share."""
    line.add_argument("--robot", required=True, help="name of a folder in robots/, or a path")
    line.add_argument("--groups", type=program.names, metavar="NAME,...", help="of the robot")
    line.add_argument("--rate", type=positive, default=30.0, help="of everything, per second")
    line.add_argument("--width", type=int, default=640)
    line.add_argument("--height", type=int, default=480)
    line.add_argument(
        "--deadline", type=positive, default=0.3, help="seconds without a command until it holds"
    )
    line.add_argument("--seed", type=int, default=0, help="grain of the pictures, first layout")
    line.add_argument("--bench", default="none", help="what there is to touch, as of runtime.simulation.node")
    line.add_argument("--blocks", type=int, default=1, help="on the tabletop; the first is the task's")
    line.add_argument("--start-pose", metavar="NAME", default="home", help="a pose of the robot")
    line.add_argument("--no-eef", action="store_true", help="it publishes no poses of its end effectors")
    line.add_argument(
        "--other-pictures",
        action="store_true",
        help="fault: Image where the topic's name says compressed, or else",
    )
    line.add_argument(
        "--topics-of", type=int, choices=(1, 2), help="the ROS whose topics of the robot's description it has"
    )
    line.add_argument("--as-simulation", action="store_true", help="it obeys the topics of a simulation")
    line.add_argument("--encoding", default="bgr8", help="said of raw pictures, which are bgr8")
    line.add_argument("--wrong-names", action="store_true", help="fault: joints have other names")
    line.add_argument("--silence", metavar="TOPIC", help="fault: nothing is published there")
    line.add_argument("--silence-from", type=int, default=0, metavar="N", help="fault: from this tick on")
    line.add_argument("--clock-offset", type=float, default=0.0, metavar="S", help="added to its clock")
    program.add_arguments(line)
