"""Interface between a ROS transport and a middleware: four methods that exchange bytes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

from pydantic import Field

from runtime.core.settings import Settings
from runtime.transports.ros.messages import MessageName

Deliver: TypeAlias = Callable[[bytes], None]
Publish: TypeAlias = Callable[[bytes], None]


class Quality(Settings):
    """Quality of service of a topic, if it differs from the usual."""

    reliability: Literal["best_effort", "reliable"] | None = None
    """Absent: reliable for commands, best effort for everything else. A best-effort subscriber receives from every
    publisher, a reliable one only from reliable publishers; a best-effort publisher reaches only best-effort
    subscribers."""
    durability: Literal["volatile", "transient_local"] = "volatile"
    """Whether late subscribers receive the last messages (transient_local); refused for commands."""
    depth: int | None = Field(default=None, ge=1, le=1000)
    """Number of messages that are queued for a slow reader; absent: 1 for commands, 5 for everything else."""

    def merged_over(self, usual: Quality) -> Quality:
        """Return these settings; keys that are not set are taken from `usual`."""
        return usual.model_copy(update=self.model_dump(exclude_none=True))


SENSOR_QUALITY = Quality(reliability="best_effort", depth=5)
COMMAND_QUALITY = Quality(reliability="reliable", depth=1)
COMMAND_LIFE_S = 0.2  # [s]; an older command is no longer delivered


@dataclass(frozen=True, slots=True)
class Topic:
    """Topic by its ROS name, e.g. "/joint_states", with its message type and quality of service."""

    name: str
    message: MessageName
    quality: Quality


@dataclass(frozen=True, slots=True)
class Match:
    """Number of connected peers of a topic; `refused` is a sentence on why a further peer was refused, or ""."""

    peers: int
    refused: str = ""


class Middleware(ABC):
    """Node of a middleware; `close` ends it. Methods raise TransportError for operations that fail."""

    @abstractmethod
    def subscribe(self, topic: Topic, deliver: Deliver) -> None:
        """Call `deliver` with the bytes of each message, from a thread of the middleware."""

    @abstractmethod
    def advertise(self, topic: Topic) -> Publish:
        """Return a publisher of bytes on the topic that waits for no peer."""

    @abstractmethod
    def matches(self) -> Mapping[str, Match]:
        """Return the peers of each subscribed or advertised topic."""

    @abstractmethod
    def close(self) -> None:
        """Release all resources. After it returns nothing is delivered. Safe to call twice."""


def describe_incompatible(topic: Topic, policy: str, publishes: bool) -> str:
    """Return the sentence about a peer that was refused because of a quality-of-service policy."""
    side, peer = ("publish", "a subscriber") if publishes else ("subscribe to", "a publisher")
    requested = topic.quality.model_dump()
    value = requested.get(policy, "as is")
    return (
        f"{peer} of {topic.name} is incompatible in its {policy}: we {side} it with {policy} = {value}; "
        f'change transport.qos."{topic.name}".{policy}, or the robot\'s side'
    )
