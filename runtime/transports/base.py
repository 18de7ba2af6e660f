"""A transport: a source of observations (held by reception) and a sink for commands (held by control)."""

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
    """Abilities of a transport; a deployment that asks for more is refused at set-up."""

    moves_robot: bool  # commands reach something that can break: report-only safety is refused
    is_finite: bool = False  # the source runs out (a recording)
    measures_eef: bool = False
    spaces: frozenset[str] = frozenset(
        {"joint"}
    )  # command spaces it can publish; "eef" comes along with joints
    poses: tuple[
        PoseFormat, ...
    ] = ()  # formats of poses that it takes where it publishes "eef"; any where empty
    drives_itself: bool = (
        False  # its robot reads a leader of its own when it is told to, and reports what it applied
    )
    resets_bench: bool = (
        False  # declared simulated: it lays out its bench when told, and says the truth of it
    )


class Source(ABC):
    """Delivers observations, newest by arrival."""

    @abstractmethod
    def connect(self) -> None:
        """Open what there is to open; raises TransportError with a sentence where that fails."""

    @abstractmethod
    def receive(self, timeout: float) -> Observation | None:
        """The newest observation not yet delivered, waiting at most `timeout` seconds; None where there is none.

        A malformed message is counted in `faults()` and skipped; it never ends the caller's loop.
        """

    @abstractmethod
    def close(self) -> None:
        """Release everything; safe to call twice."""

    def begin_run(self) -> None:  # noqa: B027  # a live robot has nothing to do
        """A run starts: a recording plays from its first frame."""

    def end_run(self) -> None:  # noqa: B027
        """The run is over: a video shows its first picture again."""

    def faults(self) -> dict[str, int]:
        """Counts by name of what went wrong since connect, e.g. {"clock_backwards": 1, "malformed": 3}."""
        return {}

    def describe_fault(self, fault: str) -> str:
        """The newest sentence about one of `faults`; "" where its name says all there is to say."""
        return ""

    def camera_health(self) -> dict[str, dict[str, Any]]:
        """Health of each camera of the deployment's own; {} where all pictures come from the transport."""
        return {}

    def pop_events(self) -> list[Event]:
        """Events since the last call of which the operator is told."""
        return []


class Sink(ABC):
    """Sends commands; never blocks the control tick."""

    @abstractmethod
    def connect(self) -> None:
        """Open what there is to open; raises TransportError with a sentence where that fails."""

    @abstractmethod
    def send(self, command: RobotCommand) -> None:
        """Hand over one command without waiting for anybody."""

    def send_control_word(self, word: str, data: Mapping[str, Any]) -> None:
        """Hand over a control word with its fields, without waiting; raises TransportError where it takes none.

        A word may be lost like a command: who needs it obeyed repeats it until the observations show that it was.
        """
        raise TransportError(f"this transport takes no control words; {word!r} was to be sent")

    def missing_subscribers(self) -> dict[str, str]:
        """Places of commands that no peer takes, each with a sentence on why, or "" where nothing is known.

        {} also where a transport cannot know. Asks no peer and waits for nothing; raises TransportError.
        """
        return {}

    @abstractmethod
    def close(self) -> None:
        """Release everything; safe to call twice."""
