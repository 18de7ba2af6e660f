"""Dialects of real-time chunking (RTC): their additions to the messages of a policy protocol."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

from runtime.core.errors import ContradictionError, PolicyError, WrongProtocolError
from runtime.core.types import Conditioning

Message = dict[str, Any]


class Dialect(ABC):
    """Dialect of RTC messages: wraps requests and unwraps replies. Each policy has its own instance, for one thread.

    There is no common standard. A dialect raises an error if the metadata show that the server uses another one.
    `continues_model_rows` is True if the previous chunk is sent back in the model's own space whenever the server has
    returned it in that space.
    """

    continues_model_rows = True

    @abstractmethod
    def check_supported(self, metadata: Mapping[str, Any]) -> bool | None:
        """Return True if the server continues a previous chunk, None if its metadata do not state it.

        Raises PolicyError if it uses another dialect.
        """

    @abstractmethod
    def wrap(self, observation: Message, conditioning: Conditioning | None) -> Message:
        """Return the message that carries the request `observation` and the conditioning."""

    @abstractmethod
    def unwrap(self, reply: Message) -> Message:
        """Return the part of a reply that contains the actions.

        Raises PolicyError for an error, or for a reply to another request.
        """


class NoRtc(Dialect):
    """Dialect without RTC: it sends no conditioning, because a server would drop the unknown keys without an error."""

    def check_supported(self, metadata: Mapping[str, Any]) -> bool | None:
        """Return False, because nothing is continued."""
        refuse_envelopes(metadata, "none")
        return False

    def wrap(self, observation: Message, conditioning: Conditioning | None) -> Message:
        """Return the observation itself. Raises PolicyError if there is conditioning."""
        if conditioning is not None:
            raise PolicyError(
                "plain openpi servers drop RTC conditioning without a word; choose an RTC protocol (policy.rtc)"
            )
        return observation

    def unwrap(self, reply: Message) -> Message:
        """Return the reply itself."""
        return reply


def declared_dialect(metadata: Mapping[str, Any], name: str) -> Mapping[str, Any] | None:
    """Return the value of the metadata key `rtc`, a map that declares the dialect; None if there is no such key.

    Our bundled server has this key. `name` is the configured dialect.

    Raises PolicyError if the server accepts only versioned envelopes, or if the value is not a map with a dialect.
    """
    refuse_envelopes(metadata, name)
    declared = metadata.get("rtc")
    if declared is None:
        return None
    if not isinstance(declared, Mapping) or not isinstance(declared.get("dialect"), str):
        raise WrongProtocolError(
            f"the server's metadata have rtc = {declared!r}; expected a map with a dialect"
        )
    return declared


def refuse_envelopes(metadata: Mapping[str, Any], configured: str) -> None:
    """Raise ContradictionError if the metadata show that the server accepts only versioned envelopes."""
    if "async_rtc" in metadata:
        raise ContradictionError(
            f"the server's metadata have async_rtc, so it takes envelopes alone; policy.rtc is {configured!r}, "
            "allowed with this server: 'async_rtc'"
        )
