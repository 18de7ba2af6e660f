"""Policy interface: a policy answers an observation with a chunk of actions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from runtime.core.types import ActionChunk, Conditioning, Observation, Space
from runtime.policies.connection import Dial


@dataclass(frozen=True, slots=True)
class PolicyInfo:
    """Description of a policy, returned when it is connected; None for unknown fields."""

    name: str
    action_space: Space | None = None
    horizon: int | None = None  # rows per response
    rate: float | None = None  # rate of its rows [Hz]; None: the control rate
    supports_rtc: bool | None = False  # whether it continues a previous chunk
    metadata: Mapping[str, object] = field(default_factory=dict)


class Policy(ABC):
    """Connection to one policy, with one request at a time and a deadline for every wait.

    `observation_eef` selects the poses that the policy receives and to which its relative chunks refer: "measured" by
    the robot, or "fk", computed from its joints. Without measured poses the computed poses are always used.
    """

    observation_eef: Literal["measured", "fk"] = "measured"
    uses_poses: bool = False  # its responses depend on the poses of an observation
    observe_period_s: float | None = (
        None  # period at which `observe` is called during a run, also between requests [s]; None: never
    )
    uses_images: bool = True  # it receives the pictures of an observation
    is_person: bool = False  # a person drives the robot through it: its episodes are demonstrations
    is_queried: bool = True  # False if the robot is driven by its own node, so that nothing is requested
    # Function that returns the (host, port) to connect to instead of the url's, such as the near end of a tunnel. It is
    # called before each connection and raises PolicyError if there is none. Everything else, including the name in
    # certificates, comes from the url.
    address_override: Dial | None = None

    @abstractmethod
    def connect(self) -> PolicyInfo:
        """Connect to the policy. Raises PolicyError with the reason if that fails."""

    @abstractmethod
    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """Return the chunk for an observation.

        Raises PolicyError. A connection that timed out is dropped, not reused.
        """

    def observe(self, observation: Observation) -> None:  # noqa: B027  # not abstract: most need only the requests
        """Receive an observation; called every `observe_period_s` during a run.

        Must not block, even while a request is pending.
        """

    @abstractmethod
    def reset(self) -> None:
        """Start a new episode; a reply that is still pending counts as one of the previous episode."""

    def resume(self) -> None:  # noqa: B027  # not abstract: most depend on the observation alone
        """Continue the episode after a hold during which there were no requests; called before the next `infer`."""

    def end_episode(self) -> None:  # noqa: B027  # not abstract: most servers keep no state
        """End the rollout on the server if it keeps state.

        `reset` is called before the next rollout. Raises PolicyError.
        """

    @abstractmethod
    def close(self) -> None:
        """Release all resources. Safe to call twice."""
