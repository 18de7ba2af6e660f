"""Interface of a policy: it answers an observation with a chunk of actions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from runtime.core.types import ActionChunk, Conditioning, Observation, Space
from runtime.policies.connection import Dial


@dataclass(frozen=True, slots=True)
class PolicyInfo:
    """The policy's statement of itself when it is reached; None where it does not say."""

    name: str
    action_space: Space | None = None
    horizon: int | None = None  # rows of an answer
    rate: float | None = None  # of its rows [Hz]; None: the control rate
    supports_rtc: bool | None = False  # it continues a chunk that it is given
    metadata: Mapping[str, object] = field(default_factory=dict)


class Policy(ABC):
    """One connection to one policy; one request in flight, every wait has a deadline.

    `observation_eef` says which poses it is shown where the robot measures its own, and what relative chunks are
    relative to; where the robot measures none, those of its joints in any case.
    """

    observation_eef: Literal["measured", "fk"] = "measured"
    uses_poses: bool = False  # its answers depend on the poses of an observation
    observe_period_s: float | None = (
        None  # how often it is to be shown what is seen, between requests too [s]; None: never
    )
    uses_images: bool = True  # it is shown those of an observation
    is_queried: bool = True  # False where nobody is asked, because the robot is driven by its own node
    # Where a server is connected to in the place of its url's host and port, as the near end of a tunnel; asked before
    # each connection, raises PolicyError where there is none. All else, names of certificates included, is of the url.
    address_override: Dial | None = None

    @abstractmethod
    def connect(self) -> PolicyInfo:
        """Reach the policy; raises PolicyError with a sentence that says what was found instead."""

    @abstractmethod
    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """The chunk for this observation; raises PolicyError. A connection that timed out is dropped, not reused."""

    def observe(self, observation: Observation) -> None:  # noqa: B027  # most see only what they are asked about
        """Take in an observation, every `glances_s` of a run, without waiting even for a pending request."""

    @abstractmethod
    def reset(self) -> None:
        """Forget the episode; a reply still in flight belongs to the old one."""

    def resume(self) -> None:  # noqa: B027  # most answer what they are shown
        """The episode goes on after a hold in which nothing was asked; called before the next inference."""

    def end_episode(self) -> None:  # noqa: B027  # most servers keep nothing of a rollout
        """The rollout is over: end what the server keeps of it; raises PolicyError. `reset` comes before the next."""

    @abstractmethod
    def close(self) -> None:
        """Release everything; safe to call twice."""
