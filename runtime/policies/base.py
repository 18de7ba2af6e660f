"""What a policy is: something that answers an observation with a chunk of actions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from runtime.types import ActionChunk, Conditioning, Observation, Space


@dataclass(frozen=True, slots=True)
class PolicyInfo:
    """What the policy says of itself when it is reached; None where it does not say."""

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
    sees_poses: bool = False  # its answers depend on the poses of an observation

    @abstractmethod
    def connect(self) -> PolicyInfo:
        """Reach the policy; raises PolicyError with a sentence that says what was found instead."""

    @abstractmethod
    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        """The chunk for this observation; raises PolicyError. A connection that timed out is dropped, not reused."""

    @abstractmethod
    def reset(self) -> None:
        """Forget the episode; a reply still in flight belongs to the old one."""

    @abstractmethod
    def close(self) -> None:
        """Release everything; safe to call twice."""
