"""Messages for both serializations of ROS: drawn by hypothesis, compared, and as rosbags has them."""

from __future__ import annotations

import functools
from dataclasses import astuple
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from runtime.transports.ros.messages import (
    PACKAGES,
    CompressedImage,
    Image,
    JointState,
    Message,
    MessageName,
    PoseStamped,
)

MESSAGES: dict[MessageName, type[Message]] = {
    "JointState": JointState,
    "Image": Image,
    "CompressedImage": CompressedImage,
    "PoseStamped": PoseStamped,
}
NAMES: list[MessageName] = list(MESSAGES)


def messages(text: st.SearchStrategy[str], stamps: st.SearchStrategy[int]) -> st.SearchStrategy[Message]:
    """Any message with texts and stamps [ns] that the serialization has."""
    finite = st.floats(allow_nan=False)
    doubles = arrays.arrays(np.float64, st.integers(0, 9), elements=finite)
    octets = arrays.arrays(np.uint8, st.integers(0, 40))
    u32 = st.integers(0, 2**32 - 1)
    names = st.lists(text, max_size=4).map(tuple)
    return st.one_of(
        st.builds(JointState, stamps, text, names, doubles, doubles, doubles),
        st.builds(Image, stamps, text, u32, u32, text, u32, octets),
        st.builds(CompressedImage, stamps, text, text, octets),
        st.builds(PoseStamped, stamps, text, arrays.arrays(np.float64, 7, elements=finite)),
    )


def name_of(message: Message) -> MessageName:
    return next(name for name, kind in MESSAGES.items() if isinstance(message, kind))


def same(one: Message, other: Message) -> bool:
    pairs = zip(astuple(one), astuple(other), strict=True)
    return all(np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b for a, b in pairs)


class Rosbags:
    """What rosbags knows of one generation of ROS, by the name of its type store; skips where rosbags is absent."""

    def __init__(self, store: str, *counted: int) -> None:
        self._name = store
        self._counted = counted  # what the header has before its time: ROS 1 counts messages there

    @functools.cached_property
    def store(self) -> Any:
        typesys = pytest.importorskip("rosbags.typesys", reason="rosbags (extra dev) is not installed")
        return typesys.get_typestore(typesys.Stores[self._name])

    def kind(self, message: Message) -> str:
        return f"{PACKAGES[name_of(message)]}/msg/{name_of(message)}"

    def message(self, message: Message) -> Any:
        """The same message as rosbags has it."""
        made = self.store.types
        time = made["builtin_interfaces/msg/Time"](*divmod(message.stamp, 10**9))
        header = made["std_msgs/msg/Header"](*self._counted, time, message.frame)
        if isinstance(message, JointState):
            kind = made["sensor_msgs/msg/JointState"]
            return kind(header, list(message.names), message.position, message.velocity, message.effort)
        if isinstance(message, Image):
            fields = (message.height, message.width, message.encoding, 0, message.step, message.data)
            return made["sensor_msgs/msg/Image"](header, *fields)
        if isinstance(message, CompressedImage):
            return made["sensor_msgs/msg/CompressedImage"](header, message.format, message.data)
        point = made["geometry_msgs/msg/Point"](*message.pose[:3])
        turn = made["geometry_msgs/msg/Quaternion"](*message.pose[3:])
        return made["geometry_msgs/msg/PoseStamped"](header, made["geometry_msgs/msg/Pose"](point, turn))
