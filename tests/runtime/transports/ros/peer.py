"""The other side of a ROS 2 topic in the hands of a test: cyclonedds with its own codec, over loopback UDP.

A domain of this process has one configuration and passes messages without a socket. So the peer lives in another
domain of the process, which on the wire is the tested one.
"""

from __future__ import annotations

import itertools
from typing import Any

import pytest

pytest.importorskip("cyclonedds", reason="the package cyclonedds (extra ros2) is not installed")

from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from runtime.simulation.ros import ros2_types as types
from runtime.transports.ros.dds_middleware import LOOPBACK, configuration
from tests.processes import eventually

_own = itertools.count(120)
RELIABLE = Policy.Reliability.Reliable(duration(milliseconds=100))
BEST_EFFORT = Policy.Reliability.BestEffort


class Peer:
    """A participant with readers and writers by topic."""

    def __init__(self, domain: int) -> None:
        number = next(_own)
        configured = configuration(LOOPBACK)
        assert configured is not None
        external = f"<Discovery><ExternalDomainId>{domain}</ExternalDomainId>"
        self._entities: list[Any] = [Domain(number, configured.replace("<Discovery>", external))]
        self._entities.append(DomainParticipant(number))
        self._writers: dict[str, Any] = {}
        self._readers: dict[str, Any] = {}

    def writer(self, topic: str, kind: Any = types.JointState, *policies: Any) -> Any:
        if topic not in self._writers:
            channel = Topic(self._entities[1], f"rt{topic}", kind)
            quality = Qos(*(policies or (RELIABLE,)), *_kept(policies))
            self._writers[topic] = DataWriter(self._entities[1], channel, quality)
        return self._writers[topic]

    def reader(self, topic: str, kind: Any = types.JointState, *policies: Any) -> Any:
        if topic not in self._readers:
            channel = Topic(self._entities[1], f"rt{topic}", kind)
            quality = Qos(*(policies or (RELIABLE,)), *_kept(policies))
            self._readers[topic] = DataReader(self._entities[1], channel, quality)
        return self._readers[topic]

    def heard(self, topic: str, at_least: int = 1) -> list[Any]:
        """So many messages or more, within ten seconds."""
        found: list[Any] = []

        def come() -> bool:
            found.extend(one for one in self._readers[topic].take(100) if hasattr(one, "header"))
            return len(found) >= at_least

        eventually(come, f"{at_least} messages on {topic}")
        return found

    def matched(self, topic: str) -> None:
        """Wait until the topic has a peer."""
        if topic in self._writers:
            matched = self._writers[topic].get_matched_subscriptions
        else:
            matched = self._readers[topic].get_matched_publications
        eventually(lambda: len(matched()), f"a peer of {topic}")

    def close(self) -> None:
        for entity in reversed(self._entities):
            entity.__del__()
        self._entities.clear()


def _kept(policies: tuple[Any, ...]) -> tuple[Any, ...]:
    return (Policy.History.KeepLast(20),)


def joints(names: list[str], position: list[float], stamp: float = 1000.0) -> Any:
    return types.JointState(header(stamp), names, position)


def header(stamp: float) -> Any:
    nanoseconds = round(stamp * 1e9)
    return types.Header(types.Time(*divmod(nanoseconds, 10**9)))
