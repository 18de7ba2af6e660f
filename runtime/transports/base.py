"""Transport interface: a source of observations (used by reception) and a sink for commands (used by control)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from runtime.core.errors import TransportError
from runtime.core.pose_format import PoseFormat
from runtime.core.types import Observation, RobotCommand
from runtime.ipc.messages import Event


@dataclass(frozen=True, slots=True)
class Capabilities:
    """Abilities of a transport. A deployment that needs more is refused at set-up."""

    moves_robot: bool  # commands reach real hardware, so report-only safety is refused
    is_finite: bool = False  # the source ends (a recording)
    measures_eef: bool = False
    spaces: frozenset[str] = frozenset({"joint"})  # command spaces that it publishes; "eef" includes "joint"
    poses: tuple[PoseFormat, ...] = ()  # accepted pose formats for "eef"; empty: any
    drives_itself: bool = False  # on request its node follows its own leader and reports the actions
    bench: str = ""  # of a declared simulation, which resets this bench and reports its ground truth


class Source(ABC):
    """Source of observations; the newest observation is the one that arrived last."""

    @abstractmethod
    def connect(self) -> None:
        """Open sockets, files or nodes. Raises TransportError with a sentence for the operator if that fails."""

    @abstractmethod
    def receive(self, timeout: float) -> Observation | None:
        """Return the newest observation that was not delivered yet, or None after `timeout` [s] without one.

        A malformed message is counted in `faults()` and skipped; it never ends the caller's loop.
        """

    @abstractmethod
    def close(self) -> None:
        """Release all resources. Safe to call twice."""

    def begin_run(self) -> None:  # noqa: B027  # not abstract: a live robot needs nothing
        """Start a run; a source that plays a recording starts from its first frame."""

    def end_run(self) -> None:  # noqa: B027
        """End the run; a source that plays a video returns to its first picture."""

    def faults(self) -> dict[str, int]:
        """Return the count of each fault since `connect`, e.g. {"clock_backwards": 1, "malformed": 3}."""
        return {}

    def describe_fault(self, fault: str) -> str:
        """Return a sentence about the latest occurrence of a fault in `faults`, "" if its name is sufficient."""
        return ""

    def camera_health(self) -> dict[str, dict[str, Any]]:
        """Return the health of cameras that the deployment opens itself; {} if all pictures come from the transport."""
        return {}

    def pop_events(self) -> list[Event]:
        """Return the events for the operator that have occurred since the last call."""
        return []


class Sink(ABC):
    """Sink of commands that never blocks the control tick."""

    @abstractmethod
    def connect(self) -> None:
        """Open sockets or nodes. Raises TransportError with a sentence for the operator if that fails."""

    @abstractmethod
    def send(self, command: RobotCommand) -> None:
        """Send one command without waiting for a peer."""

    def send_control_word(self, word: str, data: Mapping[str, Any]) -> None:
        """Send a control word with its fields, without waiting.

        A control word may be lost like any command: repeat it until the observations show its effect.

        Raises:
            TransportError: This transport has no control words, or the word cannot be sent.
        """
        raise TransportError(f"this transport takes no control words; {word!r} was to be sent")

    def missing_subscribers(self) -> dict[str, str]:
        """Return the command topics that have no subscriber, each with the reason ("" if the reason is unknown).

        The result is {} if the transport cannot tell. This method sends no request and does not block. Raises
        TransportError.
        """
        return {}

    @abstractmethod
    def close(self) -> None:
        """Release all resources. Safe to call twice."""
