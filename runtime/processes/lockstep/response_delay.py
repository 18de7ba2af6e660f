"""Declared delay of a policy's responses, which replaces the real duration of an inference in lockstep."""

from __future__ import annotations

import numpy as np

from runtime.policies.response_delay import ResponseDelaySettings
from runtime.station.spec import StationSpec


def draw_delay(spec: StationSpec, seed: int, number: int) -> float | None:
    """Return the delay [s] of response `number` of a run with `seed`; None if the policy declares none.

    Of a list, each value has the same probability. Seed and number alone determine the choice, so that two policies
    with the same list have the same delays on the same bench, and a repeated run has those of the first.
    """
    policy = spec.deployment.policy
    if spec.collecting or not isinstance(policy, ResponseDelaySettings) or policy.delay_ms is None:
        return None
    if not isinstance(policy.delay_ms, list):
        return policy.delay_ms / 1e3
    chosen = np.random.default_rng([seed, number]).integers(len(policy.delay_ms))
    return policy.delay_ms[int(chosen)] / 1e3
