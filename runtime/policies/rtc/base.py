"""Dialects of real-time chunking: their changes to the messages of a policy protocol."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

from runtime.core.errors import ContradictionError, PolicyError, WrongProtocolError
from runtime.core.types import Conditioning

Message = dict[str, Any]


class Dialect(ABC):
    """Wraps requests and unwraps replies; one per connection's policy, for one thread.

    There is no common standard. Each dialect says what it found where a server speaks another one.
    `continues_model_rows` is whether a chunk is given back in the model's own space where the server returned that.
    """

    continues_model_rows = True

    @abstractmethod
    def check_supported(self, metadata: Mapping[str, Any]) -> bool | None:
        """True if the server continues a chunk that it is given; None where its metadata do not say.

        Raises PolicyError where it speaks another dialect.
        """

    @abstractmethod
    def wrap(self, observation: Message, conditioning: Conditioning | None) -> Message:
        """The message to send for an observation."""

    @abstractmethod
    def unwrap(self, reply: Message) -> Message:
        """The part of a reply that holds the actions; PolicyError for an error, or a reply to something else."""


class NoRtc(Dialect):
    """No RTC: servers drop keys that they do not know, so conditioning would be sent and do nothing."""

    def check_supported(self, metadata: Mapping[str, Any]) -> bool | None:
        """Never."""
        refuse_envelopes(metadata, "none")
        return False

    def wrap(self, observation: Message, conditioning: Conditioning | None) -> Message:
        """The observation itself; PolicyError for conditioning."""
        if conditioning is not None:
            raise PolicyError(
                "plain openpi servers drop RTC conditioning without a word; choose an RTC protocol (policy.rtc)"
            )
        return observation

    def unwrap(self, reply: Message) -> Message:
        """The reply itself."""
        return reply


def declared_dialect(metadata: Mapping[str, Any], name: str) -> Mapping[str, Any] | None:
    """The map under the metadata key `rtc`, that of our bundled server; None where the server does not say.

    ContradictionError for a server that takes versioned envelopes alone, or whose key is something else.
    """
    refuse_envelopes(metadata, name)
    said = metadata.get("rtc")
    if said is None:
        return None
    if not isinstance(said, Mapping) or not isinstance(said.get("dialect"), str):
        raise WrongProtocolError(f"the server's metadata have rtc = {said!r}; expected a map with a dialect")
    return said


def refuse_envelopes(metadata: Mapping[str, Any], configured: str) -> None:
    """ContradictionError where the server says that it takes versioned envelopes: it would answer nothing else."""
    if "async_rtc" in metadata:
        raise ContradictionError(
            f"the server's metadata have async_rtc, so it takes envelopes alone; policy.rtc is {configured!r}, "
            "allowed with this server: 'async_rtc'"
        )
