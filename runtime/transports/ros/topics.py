"""Topics of a deployment: those in the robot's description, unless the deployment names others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from runtime.core.errors import ConfigurationError
from runtime.core.settings import Settings
from runtime.transports.ros.messages import MessageName

if TYPE_CHECKING:
    from robots import Camera, Group, Robot

TopicName = Annotated[str, Field(pattern=r"^(/[A-Za-z_][A-Za-z0-9_]*)+$|^$")]
Target = Literal["robot", "simulation"]


class GroupTopics(Settings):
    """Topics of one group that differ from those in the robot's description; "" for a topic that does not exist."""

    state: TopicName | None = None
    """sensor_msgs/JointState: measured joints of the group."""
    command: TopicName | None = None
    """sensor_msgs/JointState: commanded joints of the group."""
    eef: TopicName | None = None
    """geometry_msgs/PoseStamped: measured pose of the end effector, in the group's own frame."""
    eef_command: TopicName | None = None
    """geometry_msgs/PoseStamped: commanded pose of the end effector."""
    gripper_state: TopicName | None = None
    """sensor_msgs/JointState: measured gripper, if its value is not part of `state`."""
    gripper_command: TopicName | None = None
    """sensor_msgs/JointState: commanded gripper, if its value is not part of `command`."""
    simulation: TopicName | None = None
    """sensor_msgs/JointState: the same command, for a simulation that runs in parallel with the robot."""
    joints: list[str] | None = None
    """Names of the group's joints in the messages, in the group's order; absent: those of the robot's description."""


class Topics(Settings):
    """Topics that differ from those in the robot's description."""

    cameras: dict[str, TopicName] = Field(default_factory=dict)
    """Image topics by logical name of the camera."""
    groups: dict[str, GroupTopics] = Field(default_factory=dict)
    """Topics by name of the group."""


@dataclass(frozen=True, slots=True)
class StreamSpec:
    """One stream of a frame: its kind, its group or camera key, and its topic.

    A message of joints may contain more joints than the stream needs. `joints` names the joints whose values are read,
    by their names in the message, in the order of the group.
    """

    kind: Literal["joints", "gripper", "eef", "camera"]
    source_key: str
    topic: str
    message: MessageName
    joints: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the stream: a camera's key, or e.g. "left_arm joints"."""
        return self.source_key if self.kind == "camera" else f"{self.source_key} {self.kind}"


@dataclass(frozen=True, slots=True)
class CommandTopic:
    """Topic for commands, with the dimensions `dims` of the robot's vector that it carries and their joint names.

    For a pose, `arm` is the arm's index among the robot's arms, and `frame` is the frame of the pose.
    """

    topic: str
    message: MessageName
    dims: tuple[int, ...] = ()
    joints: tuple[str, ...] = ()
    arm: int = -1
    frame: str = ""


class TopicPlan:
    """Topics of one robot. Raises ConfigurationError for topics that are missing or do not fit the robot."""

    def __init__(self, robot: Robot, version: Literal[1, 2], given: Topics, disabled: list[str]) -> None:
        self._robot, self._given = robot, given
        self._own = robot.ros if robot.ros is not None and robot.ros.version == version else None
        _require_known("topics.cameras", given.cameras, [camera.name for camera in robot.cameras], robot)
        _require_known("topics.groups", given.groups, [group.name for group in robot.groups], robot)
        _require_known("disabled_cameras", disabled, [camera.key for camera in robot.cameras], robot)
        self.cameras = tuple(camera for camera in robot.cameras if camera.key not in disabled)
        for group in robot.groups:
            self._check_joints(group)

    def streams(self, eef: bool) -> tuple[StreamSpec, ...]:
        """Return all streams of a frame; if `eef`, with those of measured poses."""
        specs = [self._camera(camera) for camera in self.cameras]
        for group in self._robot.groups:
            specs += self._state(group)
            if eef and group.chain is not None:
                topic = self._required(group, "eef", "eef = true needs the poses of every arm")
                specs.append(StreamSpec("eef", group.name, topic, "PoseStamped"))
        return tuple(specs)

    def command_topics(self, targets: Sequence[Target], eef: bool) -> tuple[CommandTopic, ...]:
        """Return the command topics, which carry poses if `eef`, in the order of the targets.

        Targets or groups with the same topic share one message.
        """
        merged: dict[str, CommandTopic] = {}
        for target in targets:
            for group in self._robot.groups:
                for outlet in self._commands(group, target, eef):
                    merged[outlet.topic] = _merged(merged.get(outlet.topic), outlet)
        return tuple(merged.values())

    def _camera(self, camera: Camera) -> StreamSpec:
        topic = self._given.cameras.get(camera.name)
        if topic is None and self._own is not None:
            topic = self._own.cameras.get(camera.name)
        if not topic:
            raise ConfigurationError(
                f"transport: no topic of camera {camera.name} ({camera.key}) is known; needed: "
                f'transport.topics.cameras.{camera.name}, or "{camera.key}" among transport.disabled_cameras'
            )
        compressed = topic.endswith("/compressed")
        return StreamSpec("camera", camera.key, topic, "CompressedImage" if compressed else "Image")

    def _state(self, group: Group) -> Iterator[StreamSpec]:
        names = self._names(group)
        topic = self._required(group, "state", "every group needs a topic of its joint positions")
        apart = self._topic(group, "gripper_state")
        index = None if group.gripper is None else group.gripper.index
        if not apart or index is None:
            yield StreamSpec("joints", group.name, topic, "JointState", names)
            return
        yield StreamSpec("joints", group.name, topic, "JointState", names[:index] + names[index + 1 :])
        yield StreamSpec("gripper", group.name, apart, "JointState", (names[index],))

    def _commands(self, group: Group, target: Target, eef: bool) -> Iterator[CommandTopic]:
        names, dims = self._names(group), tuple(range(group.slice.start, group.slice.stop))
        if target == "simulation":
            topic = self._required(group, "simulation", 'commands_to has "simulation"')
            yield CommandTopic(topic, "JointState", dims, names)
            return
        if eef and group.chain is not None:
            topic = self._required(group, "eef_command", "eef_commands = true needs one for every arm")
            place = [arm.name for arm in self._robot.arms].index(group.name)
            yield CommandTopic(topic, "PoseStamped", arm=place, frame=group.frame or "")
            yield from self._joint_commands(group, names, dims, posed=True)
        else:
            yield from self._joint_commands(group, names, dims, posed=False)

    def _joint_commands(
        self, group: Group, names: tuple[str, ...], dims: tuple[int, ...], posed: bool
    ) -> Iterator[CommandTopic]:
        """Yield the command topics for the joints of a group: one for all, or one for the arm and one for the gripper.

        If the arm is commanded by poses (`posed`), a gripper topic is enough. Raises: ConfigurationError if a joint has
        no topic.
        """
        apart = self._topic(group, "gripper_command")
        index = None if group.gripper is None else group.gripper.index
        topic = self._topic(group, "command")
        if not topic and not (posed and (apart or index is None)):
            self._required(group, "command", "every value of the robot's command needs a topic")
        if apart and index is not None:
            yield CommandTopic(apart, "JointState", dims[index : index + 1], names[index : index + 1])
            names, dims = names[:index] + names[index + 1 :], dims[:index] + dims[index + 1 :]
        if topic:
            yield CommandTopic(topic, "JointState", dims, names)

    def _names(self, group: Group) -> tuple[str, ...]:
        names = self._given.groups.get(group.name)
        return group.joints if names is None or names.joints is None else tuple(names.joints)

    def _check_joints(self, group: Group) -> None:
        names = self._names(group)
        if len(names) != group.dof or len(set(names)) != len(names):
            raise ConfigurationError(
                f"transport.topics.groups.{group.name}.joints = {list(names)}; "
                f"allowed: {group.dof} different names, in the order of {', '.join(group.joints)}"
            )

    def _topic(self, group: Group, field: str) -> str:
        """Return the group's topic in the setting `field`, "" if it has none."""
        topic = getattr(self._given.groups.get(group.name), field, None)
        if topic is None and self._own is not None:
            topic = getattr(self._own.groups.get(group.name), field, None)
        return str(topic or "")

    def _required(self, group: Group, field: str, reason: str) -> str:
        topic = self._topic(group, field)
        if not topic:
            raise ConfigurationError(
                f"transport: no {field} topic of group {group.name} is known; needed: "
                f"transport.topics.groups.{group.name}.{field} ({reason})"
            )
        return topic


def _merged(before: CommandTopic | None, outlet: CommandTopic) -> CommandTopic:
    """Return a command topic with the joints of both, because groups may share a topic if their joint names differ.

    Raises: ConfigurationError if they cannot share it.
    """
    if before is None:
        return outlet
    joints = before.joints + outlet.joints
    if {before.message, outlet.message} != {"JointState"} or len(set(joints)) != len(joints):
        raise ConfigurationError(
            f"transport: several commands go to {outlet.topic}; allowed: one per topic, or joints alone whose names "
            f"are all different, not {', '.join(joints)}"
        )
    return replace(before, dims=before.dims + outlet.dims, joints=joints)


def _require_known(
    key: str, names: Mapping[str, object] | list[str], allowed: list[str], robot: Robot
) -> None:
    unknown = [name for name in names if name not in allowed]
    if unknown:
        raise ConfigurationError(
            f"transport.{key}: {', '.join(unknown)} not of {robot.name}; allowed: {', '.join(allowed)}"
        )
