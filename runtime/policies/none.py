"""No policy, for a station that only collects demonstrations."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from runtime.core.clock import Clock
from runtime.core.errors import PolicyError
from runtime.core.settings import Settings
from runtime.core.types import ActionChunk, Conditioning, Observation
from runtime.policies.base import Policy, PolicyInfo

if TYPE_CHECKING:
    from robots import Robot

_NONE = "this deployment has no [policy]: it is set up to collect (setup with collect = true), or given one"


class Config(Settings):
    """No policy: the default for a deployment with a [collection]."""

    kind: Literal["none"] = "none"


def build(config: Config, robot: Robot, clock: Clock, control_rate: float) -> NoPolicy:
    """Create a policy that refuses every request."""
    return NoPolicy()


class NoPolicy(Policy):
    """Policy that refuses every request with a reason."""

    def connect(self) -> PolicyInfo:
        raise PolicyError(_NONE)

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        raise PolicyError(_NONE)

    def reset(self) -> None:
        """Do nothing, because there is no state."""

    def close(self) -> None:
        """Do nothing, because there is no connection."""
