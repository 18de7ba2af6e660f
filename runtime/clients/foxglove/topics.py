"""Topics of a running station: what they are called, and their ROS 2 messages from what the station publishes.

Names and types are those of exported episodes (`runtime.interop.episode_topics`).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from runtime.clients.panel.watch import displayed_state, is_shown
from runtime.interop.ros2_messages import encode, to_header, topic_part
from runtime.ipc.session_state import complete_state_meaning

_JOINTS = {"joint_states": "measured", "joint_commands": "commanded", "joint_planned": "planned"}
STATE, EVENTS, STOPPED = "/eva/state", "/eva/events", "/eva/estop"


class Topic(NamedTuple):
    """A topic: its name, its message type without "msg/", and the station's stream that it is made of."""

    name: str
    kind: str
    stream: str


class StationTopics:
    """Topics of one station, from the facts in its snapshots."""

    def __init__(self, facts: Mapping[str, Any]) -> None:
        self._groups = dict(_group_dims(facts["joint_names"]))
        self._cameras = {
            f"camera/{camera}": f"/cameras/{topic_part(camera)}/compressed" for camera in facts["cameras"]
        }
        self.topics = (
            Topic(STATE, "std_msgs/String", "state"),
            Topic(STOPPED, "std_msgs/Bool", "state"),
            Topic(EVENTS, "evaweb_msgs/Event", "event"),
            *(
                Topic(f"/{topic_part(group)}/{name}", "sensor_msgs/JointState", "joints")
                for group in self._groups
                for name in _JOINTS
            ),
            *(Topic(name, "sensor_msgs/CompressedImage", camera) for camera, name in self._cameras.items()),
        )

    def messages(self, stream: str, content: Any, stamp: int) -> Iterator[tuple[str, bytes]]:
        """Yield (topic, encoded message) for what the station publishes in a stream; `stamp` is Unix time [ns].

        Texts that a blind plan hides are left out, as on the station's own panel.
        """
        if stream == "state":
            snapshot = complete_state_meaning(content)
            yield STATE, encode("std_msgs/String", {"data": json.dumps(displayed_state(snapshot))})
            yield STOPPED, encode("std_msgs/Bool", {"data": bool(snapshot["state_is"]["latched"])})
        elif stream == "event":
            if content.get("kind") != "truth":  # what the bench judges is for after the score
                yield EVENTS, _encode_event(content, stamp)
        elif stream == "joints":
            yield from self._joint_messages(content, stamp)
        else:
            values = {
                "header": to_header(stamp, stream.removeprefix("camera/")),
                "format": "jpeg",
                "data": content,
            }
            yield self._cameras[stream], encode("sensor_msgs/CompressedImage", values)

    def _joint_messages(self, content: Mapping[str, Any], stamp: int) -> Iterator[tuple[str, bytes]]:
        for name, key in _JOINTS.items():
            vector = np.asarray(content[key], np.float64)
            if key == "commanded" and not content["engaged"]:
                continue
            for group, (names, dims) in self._groups.items():
                position = vector[dims]
                if np.isfinite(position).all():
                    values = {"header": to_header(stamp), "name": names, "position": position}
                    values |= {"velocity": (), "effort": ()}
                    yield f"/{topic_part(group)}/{name}", encode("sensor_msgs/JointState", values)


def _group_dims(joints: Sequence[str]) -> Iterator[tuple[str, tuple[list[str], list[int]]]]:
    """Yield (group, (names, indices)) for joints that are called GROUP.JOINT."""
    groups = dict.fromkeys(joint.partition(".")[0] for joint in joints)
    for group in groups:
        dims = [dim for dim, joint in enumerate(joints) if joint.partition(".")[0] == group]
        yield group, ([joints[dim].partition(".")[2] for dim in dims], dims)


def _encode_event(event: Mapping[str, Any], stamp: int) -> bytes:
    shown = is_shown(event)
    values = {
        "header": to_header(stamp),
        "kind": str(event.get("kind", "")),
        "text": str(event.get("text", "")) if shown else "",
        "id": str(event.get("id", "")) if shown else "",
        "arguments": "{}",
        "data": "{}",
        "step": int(event.get("step", -1)),
        "time": float(event.get("time", 0.0)),
    }
    return encode("evaweb_msgs/Event", values)
