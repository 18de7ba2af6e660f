"""Mapping of a bag's topics to a robot and its cameras: read from a file, or proposed from the bag."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationError

import robots
from robots import Robot
from runtime.core.errors import RecordingError
from runtime.core.settings import Settings, explain_validation_error
from runtime.interop.bag_messages import NUMBERS, PICTURES, TEXT
from runtime.interop.bag_reader import Bag

# In names of topics, by preference.
_TASKS = ("instruction", "task", "prompt")
_OF_ACTIONS = ("command", "cmd", "action", "leader", "target", "desired", "trajectory", "executed")


class TopicSource(Settings):
    """Topic with the numbers of some joints."""

    topic: str
    joints: dict[str, str] = Field(min_length=1)
    """Joints of the robot, each with its name in the messages; in arrays, the names are indices ("0")."""


class BagMapping(Settings):
    """What the topics of a bag are."""

    robot: str
    """Name of a robot with a description, or path of its folder."""
    fps: Annotated[float, Field(gt=0, le=1000)] = 30.0
    """Rows per second."""
    task: str = ""
    """Instruction of the episodes; empty: the first message of `task_topic`."""
    task_topic: str = ""
    kind: Literal["demonstration", "rollout"] = "demonstration"
    """Who drove the robot: a person or a policy."""
    success: bool | None = None
    """Whether all episodes succeeded; absent: unknown. A dataset that says it of every episode needs it."""
    stamps: Literal["header", "log"] = "header"
    """Time of a message: its header's stamp if it has one, or the time at which it was logged."""
    max_age_s: Annotated[float, Field(gt=0)] = 0.25
    """Age of the newest message from which a gap is reported [s]."""
    state: list[TopicSource] = Field(min_length=1)
    """Measured joints."""
    action: list[TopicSource] = Field(default_factory=list)
    """Commanded joints; without any, the action of a row is the state of the next."""
    cameras: dict[str, str] = Field(default_factory=dict)
    """Topic of each camera, by the key of the camera."""

    @property
    def topics(self) -> list[str]:
        """All topics that the mapping names, each once."""
        named = [
            *(source.topic for source in (*self.state, *self.action)),
            *self.cameras.values(),
            self.task_topic,
        ]
        return [topic for topic in dict.fromkeys(named) if topic]


def read_mapping(path: Path) -> BagMapping:
    """Return the mapping in a TOML file. Raises: RecordingError, which names the file and the key."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path}: {error}") from error
    return parse_mapping(text, str(path))


def parse_mapping(text: str, where: str) -> BagMapping:
    """Return the mapping in a TOML text. Raises: RecordingError, which names `where` it was and the key."""
    try:
        tree = tomllib.loads(text)
        return BagMapping.model_validate(tree)
    except ValidationError as invalid:
        raise RecordingError(explain_validation_error(invalid, BagMapping, tree, where)) from invalid
    except ValueError as error:
        raise RecordingError(f"{where}: {error}") from error


def mapped_robot(mapping: BagMapping) -> Robot:
    """Return the robot of a mapping after comparing its joints with those of the mapping.

    Raises: RecordingError, which names joints that are missing, strange or given twice.
    """
    try:
        robot = robots.load_robot(mapping.robot)
    except robots.RobotError as error:
        raise RecordingError(f"robot = {mapping.robot!r}: {error}") from error
    topics = list(mapping.cameras.values())
    if twice := [topic for topic in topics if topics.count(topic) > 1]:
        raise RecordingError(f"cameras: {twice[0]} is given for two cameras; allowed: a topic for each")
    for role in ("state", "action"):
        sources: Sequence[TopicSource] = getattr(mapping, role)
        named = [joint for source in sources for joint in source.joints]
        problems = {
            "has no source": [joint for joint in robot.joint_names if sources and joint not in named],
            "is no joint of the robot": [joint for joint in named if joint not in robot.joint_names],
            "has two sources": sorted({joint for joint in named if named.count(joint) > 1}),
        }
        for problem, joints in problems.items():
            if joints:
                raise RecordingError(
                    f"{role}: {joints[0]} {problem} ({len(joints)} such); the joints of {robot.name} are "
                    f"{', '.join(robot.joint_names)}"
                )
    return robot


def propose_mapping(bag: Bag, robot: Robot) -> tuple[BagMapping, list[str]]:
    """Return a mapping for the topics of a bag, and a sentence for each thing that no topic was found for.

    Joints are found by their names in the messages, with or without the name of their group. Topics of commands are
    those with a word such as "command" in their names, the task's is a text named after it.

    Raises: RecordingError if no topic has measured joints.
    """
    names = {topic: bag.first_names(topic) for topic, kind in bag.kinds.items() if kind in NUMBERS}
    missing: list[str] = []
    sources: dict[str, list[TopicSource]] = {"state": [], "action": []}
    for role, found in sources.items():
        fitting = {
            topic: held for topic, held in names.items() if (role == "action") == _is_of_actions(topic)
        }
        for group in robot.groups:
            joints = [robot.joint_names[dim] for dim in range(group.slice.start, group.slice.stop)]
            best = max(
                (
                    _matched(topic, held, group.name, joints, group.name in topic or len(robot.groups) == 1)
                    for topic, held in fitting.items()
                ),
                key=lambda source: (len(source[1]), group.name in source[0], -_preference(source[0])),
                default=("", {}),
            )
            if len(best[1]) < len(joints):
                left = [joint for joint in joints if joint not in best[1]]
                missing.append(f"{role}: no topic has {', '.join(left)}")
            if best[1]:
                found.append(TopicSource(topic=best[0], joints=best[1]))
    if not sources["state"]:
        raise RecordingError(
            f"{bag.path}: no topic has joints of {robot.name}; topics with numbers: {', '.join(names) or 'none'}"
        )
    cameras = {}
    pictures = [topic for topic, kind in bag.kinds.items() if kind in PICTURES]
    for camera in robot.cameras:
        named = [topic for topic in pictures if {camera.key, camera.name} & set(topic.split("/"))]
        if named:
            cameras[camera.key] = named[0]
        else:
            missing.append(
                f"cameras: no topic is named after {camera.key}; pictures: {', '.join(pictures) or 'none'}"
            )
    texts = [topic for topic, kind in bag.kinds.items() if kind == TEXT]
    tasks = [topic for topic in texts if any(word in topic.lower() for word in _TASKS)]
    if not tasks:
        missing.append(f"task: no text topic is named after it; texts: {', '.join(texts) or 'none'}")
    return BagMapping(
        robot=robot.name,
        task_topic=tasks[0] if tasks else "",
        state=sources["state"],
        action=sources["action"],
        cameras=cameras,
    ), missing


def _is_of_actions(topic: str) -> bool:
    return _preference(topic) < len(_OF_ACTIONS)


def _preference(topic: str) -> int:
    """Return the place of the first word for actions in a topic's name; the number of these words if it has none."""
    return next((place for place, word in enumerate(_OF_ACTIONS) if word in topic.lower()), len(_OF_ACTIONS))


def _matched(
    topic: str, names: Sequence[str], group: str, joints: Sequence[str], alone: bool
) -> tuple[str, dict[str, str]]:
    """Return the topic, and the joints of a group with their names in its messages.

    A name without the group is accepted only if the topic is of this group `alone`.
    """
    found: dict[str, str] = {}
    for joint in joints:
        short = joint.removeprefix(f"{group}.")
        spellings = [joint, f"{group}_{short}", f"{group}/{short}", *([short] if alone else [])]
        name = next((spelling for spelling in spellings if spelling in names), None)
        if name is not None:
            found[joint] = name
    return topic, found


def to_toml(mapping: BagMapping) -> str:
    """Return a mapping as the text of a file for `read_mapping`."""
    import tomli_w

    tree: Mapping[str, object] = mapping.model_dump(exclude_none=True)
    return tomli_w.dumps(tree)
