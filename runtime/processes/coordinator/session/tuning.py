"""Changes of strategy, parameters and instruction of the specification in force."""

from __future__ import annotations

from dataclasses import replace

from runtime.config import loader
from runtime.core.errors import RuntimeFault
from runtime.core.plugins import variants
from runtime.core.sentences import Pattern, fixed
from runtime.ipc.command_arguments import TuneRequest
from runtime.policies.base import PolicyInfo
from runtime.processes.coordinator.inference.inference import Strategy
from runtime.station.spec import StationSpec

_NOTHING_TO_CHANGE = fixed("tuning.nothing_to_change", "tune: nothing to change; allowed: strategy, task")
_POLICY_WITHOUT_RTC = Pattern(
    "tuning.policy_without_rtc",
    "tune: the policy {policy!r} does not continue a chunk that it is given (RTC)",
)


def strategy_of(spec: StationSpec) -> Strategy:
    """Return the part of the specification's strategy that decides when to query the policy."""
    settings = spec.deployment.strategy
    return Strategy(variants("runtime.strategies")[settings.kind].query(settings), settings)


def apply_tuning(spec: StationSpec, asked: TuneRequest, info: PolicyInfo | None) -> StationSpec:
    """Return `spec` with the requested changes; another kind of strategy inherits the parameters.

    `info` is the connected policy's description, None if there is none.

    Raises:
        RuntimeFault: the request changes nothing, a value is invalid, or the policy does not support RTC.
    """
    if asked.strategy is None and asked.task is None:
        raise RuntimeFault(_NOTHING_TO_CHANGE)
    now = spec.deployment
    strategy = {**now.strategy.model_dump(), **(asked.strategy or {})}
    task = now.task if asked.task is None else asked.task
    tuned = replace(
        spec, resolved=loader.apply_changes(spec.resolved, {"strategy": strategy, "task": task}, "tune")
    )
    if info is not None and info.supports_rtc is False and strategy_of(tuned).query.uses_rtc:
        raise RuntimeFault(_POLICY_WITHOUT_RTC(policy=info.name))
    return tuned
