"""Interface of a ROS transport to a middleware: four methods, bytes in and bytes out."""

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
    """Quality of service of a topic, where it is not as usual."""

    reliability: Literal["best_effort", "reliable"] | None = None
    """Commands are reliable, all else is best effort. A best-effort subscriber hears every publisher, a reliable one
    reliable publishers alone; a best-effort publisher is heard by best-effort subscribers alone."""
    durability: Literal["volatile", "transient_local"] = "volatile"
    """Whether who comes later is given the last messages; refused for commands."""
    depth: int | None = Field(default=None, ge=1, le=1000)
    """How many messages are kept for a reader that is behind: 1 command, 5 of all else."""

    def merged_over(self, usual: Quality) -> Quality:
        """This one, with what it leaves open as in `usual`."""
        return usual.model_copy(update=self.model_dump(exclude_none=True))


SENSOR_QUALITY = Quality(reliability="best_effort", depth=5)
COMMAND_QUALITY = Quality(reliability="reliable", depth=1)
COMMAND_LIFE_S = 0.2  # after which a command that was not delivered is not delivered any more


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic as ROS names it, "/joint_states", what it carries, and how."""

    name: str
    message: MessageName
    quality: Quality


@dataclass(frozen=True, slots=True)
class Match:
    """Peers at the other side of a topic: their count, and a sentence on why others are refused, or ""."""

    peers: int
    refused: str = ""


class Middleware(ABC):
    """One node; `close` ends it. What it cannot do is a TransportError."""

    @abstractmethod
    def subscribe(self, topic: Topic, deliver: Deliver) -> None:
        """Call `deliver` with the bytes of each message, from a thread of the middleware's."""

    @abstractmethod
    def advertise(self, topic: Topic) -> Publish:
        """Publisher of bytes on the topic, without waiting for any peer."""

    @abstractmethod
    def matches(self) -> Mapping[str, Match]:
        """By topic, for all that are subscribed or advertised."""

    @abstractmethod
    def close(self) -> None:
        """Release everything; nothing is delivered once it returns. Safe to call twice."""


def describe_incompatible(topic: Topic, policy: str, publishes: bool) -> str:
    """The sentence for a peer that was refused for a policy of its quality of service."""
    side, other = ("publish", "a subscriber") if publishes else ("subscribe to", "a publisher")
    ours = topic.quality.model_dump()
    given = ours.get(policy, "as is")
    return (
        f"{other} of {topic.name} is incompatible in its {policy}: we {side} it with {policy} = {given}; "
        f'change transport.qos."{topic.name}".{policy}, or the robot\'s side'
    )
