"""What a policy is told beside requests reaches it through whatever is around it."""

from __future__ import annotations

from typing import Any

from runtime.core.types import ActionChunk, Conditioning, Observation
from runtime.policies.base import Policy, PolicyInfo
from runtime.policies.tunnel.policy import TunnelledPolicy
from tests.runtime.policies.peers import FRANKA, seen


class Telling(Policy):
    """Writes down that its rollout is over."""

    def __init__(self) -> None:
        self.rests = 0
        self.observe_period_s = 0.25
        self.glanced: list[Observation] = []

    def connect(self) -> PolicyInfo:
        raise AssertionError("nobody connects here")

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        raise AssertionError("nobody asks here")

    def observe(self, observation: Observation) -> None:
        self.glanced.append(observation)

    def reset(self) -> None:
        raise AssertionError("nobody resets here")

    def end_episode(self) -> None:
        self.rests += 1

    def close(self) -> None:
        pass


def test_a_tunnel_hands_the_end_of_a_rollout_on_and_what_is_seen_between_requests() -> None:
    policy, nothing = Telling(), None
    settings: Any = nothing
    far: Any = nothing
    tunnelled = TunnelledPolicy(policy, settings, far, "ssh")
    tunnelled.end_episode()
    assert policy.rests == 1
    assert tunnelled.observe_period_s == 0.25
    observation = seen(FRANKA)
    tunnelled.observe(observation)
    assert policy.glanced == [observation]
