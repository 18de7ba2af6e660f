"""Observations from a robot's messages: decoded, aligned, with joints in the robot's order."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from runtime.core.types import EEF_WIDTH, Float32, Float64, Observation, UInt8
from runtime.transports.frozen_cameras import FrozenCameraDetector
from runtime.transports.ros import message_reading
from runtime.transports.ros.alignment import Aligned
from runtime.transports.ros.message_reading import JointOrder, Names, UnusableMessage
from runtime.transports.ros.messages import CompressedImage, Image, JointState, Message, PoseStamped
from runtime.transports.ros.topics import StreamSpec

if TYPE_CHECKING:
    from robots import Robot


@dataclass(frozen=True, slots=True, eq=False)
class Joints:
    """Joint values of a group, or of its gripper alone, float64 [joints] in the robot's order; None if not measured."""

    position: Float64
    velocity: Float64 | None
    effort: Float64 | None


Value: TypeAlias = Joints | Float32 | Image | CompressedImage


@dataclass(frozen=True, slots=True, eq=False)
class StampedValue:
    """Decoded content of one message, with its capture time on our clock [s]."""

    value: Value
    captured: float


class MessageReaders:
    """Decoders of messages for the streams of a frame. `read` raises UnusableMessage with the reason."""

    def __init__(self, robot: Robot, parts: tuple[StreamSpec, ...], names: Names) -> None:
        self._orders = {part.name: JointOrder(part, names) for part in parts if part.message == "JointState"}
        self._frames = {
            part.name: robot.group(part.source_key).frame or "" for part in parts if part.kind == "eef"
        }

    def read(self, part: StreamSpec, message: Message) -> Value:
        if isinstance(message, JointState):
            return Joints(*self._orders[part.name].read(message))
        if isinstance(message, PoseStamped):
            return message_reading.pose(message, self._frames[part.name])
        message_reading.check_picture(message)
        return message


class Assembly:
    """Builder of observations from aligned messages. A picture is decoded once, when it is first needed."""

    def __init__(self, robot: Robot, parts: tuple[StreamSpec, ...], detect_frozen: bool) -> None:
        self._robot = robot
        self._parts = parts
        self._detect_frozen = detect_frozen
        self._freshness = FrozenCameraDetector()
        self._decoded: dict[str, tuple[StampedValue, UInt8]] = {}

    def observation(self, number: int, aligned: Aligned[StampedValue]) -> Observation:
        """Build the observation. Raises UnusableMessage if a picture cannot be decoded."""
        samples = aligned.samples
        values = {name: sample.value for name, sample in samples.items()}
        pictures = {
            part.source_key: self._picture(part, values[part.name]) for part in self._stream("camera")
        }
        position, velocity, effort = self._vectors({name: got.value for name, got in values.items()})
        eef = self._eef({name: got.value for name, got in values.items()}, position)
        return Observation(
            sequence=number,
            arrived=max(sample.arrived for sample in samples.values()),
            captured=MappingProxyType(self._captured(values, pictures)),
            qpos=position,
            pictures=MappingProxyType(pictures),
            qvel=velocity,
            effort=effort,
            eef=eef,
        )

    def newly_frozen(self, time: float) -> list[str]:
        """Return the cameras whose messages continue while the picture has stayed the same for too long; each once."""
        return self._freshness.newly_frozen(time) if self._detect_frozen else []

    def _stream(self, kind: str) -> list[StreamSpec]:
        return [part for part in self._parts if part.kind == kind]

    def _picture(self, part: StreamSpec, got: StampedValue) -> UInt8:
        cached = self._decoded.get(part.source_key)
        if cached is not None and cached[0] is got:
            return cached[1]
        assert isinstance(got.value, Image | CompressedImage)
        try:
            decoded = message_reading.picture(got.value)
        except UnusableMessage as error:
            raise UnusableMessage(error.fault, f"{part.topic}: {error}") from error
        self._decoded[part.source_key] = (got, decoded)
        return decoded

    def _captured(
        self, values: Mapping[str, StampedValue], pictures: Mapping[str, UInt8]
    ) -> dict[str, float]:
        """Return the capture time of each camera, of "joints", and of "eef" if there are poses.

        The time of "joints" and that of "eef" are each the time of the oldest message that contributes.
        """
        times = {
            "joints": min(values[p.name].captured for p in self._stream("joints") + self._stream("gripper"))
        }
        poses = self._stream("eef")
        if poses:
            times["eef"] = min(values[part.name].captured for part in poses)
        for part in self._stream("camera"):
            time = values[part.name].captured
            single = {part.source_key: pictures[part.source_key]}
            times |= (
                self._freshness.captured(single, time) if self._detect_frozen else {part.source_key: time}
            )
        return times

    def _vectors(self, values: Mapping[str, Value]) -> tuple[Float32, Float32 | None, Float32 | None]:
        """Return position, velocity and effort of the whole robot [D].

        Velocity and effort are None unless every group reports them.
        """
        positions, velocities, efforts = [], [], []
        for group in self._robot.groups:
            arm = values[f"{group.name} joints"]
            hand = values.get(f"{group.name} gripper")
            assert isinstance(arm, Joints)
            assert hand is None or isinstance(hand, Joints)
            place = None if group.gripper is None else group.gripper.index
            positions.append(_insert_gripper(arm.position, None if hand is None else hand.position, place))
            whole = hand is None or hand.velocity is not None
            velocities.append(
                _insert_gripper(arm.velocity, None if hand is None else hand.velocity, place)
                if whole
                else None
            )
            whole = hand is None or hand.effort is not None
            efforts.append(
                _insert_gripper(arm.effort, None if hand is None else hand.effort, place) if whole else None
            )
        joined = _joined(positions)
        assert joined is not None
        return joined, _joined(velocities), _joined(efforts)

    def _eef(self, values: Mapping[str, Value], position: Float32) -> Float32 | None:
        """Return the measured poses, each with its gripper from the joints: float32 [8 * arms]; None without poses."""
        if not self._stream("eef"):
            return None
        vectors = np.zeros((len(self._robot.arms), EEF_WIDTH), np.float32)
        for row, arm in zip(vectors, self._robot.arms, strict=True):
            pose = values[f"{arm.name} eef"]
            assert isinstance(pose, np.ndarray)
            row[:7] = pose
            row[7] = 0.0 if arm.gripper_dim is None else position[arm.gripper_dim]
        return vectors.reshape(-1)


def _insert_gripper(arm: Float64 | None, hand: Float64 | None, place: int | None) -> Float64 | None:
    """Return the values of a group; if its gripper has a stream of its own, `hand` is inserted at index `place`.

    None if one of them has no values.
    """
    return arm if arm is None or hand is None or place is None else np.insert(arm, place, hand[0])


def _joined(parts: list[Float64 | None]) -> Float32 | None:
    available = [part for part in parts if part is not None]
    return np.concatenate(available).astype(np.float32) if len(available) == len(parts) else None
