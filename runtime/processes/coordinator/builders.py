"""Builders of the coordinator's policy, leader and kinematics."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from robots import Robot
from runtime.core.clock import Clock
from runtime.core.errors import ConfigurationError, RuntimeFault
from runtime.core.plugins import variants
from runtime.policies.base import Policy
from runtime.policies.tunnel.policy import through_tunnel
from runtime.station.spec import StationSpec

# Imports of kinds that a deployment does not name must not be loaded.
if TYPE_CHECKING:
    from runtime.kinematics.base import Kinematics
    from runtime.teleoperators.base import Leader

MakePolicy = Callable[[StationSpec, Clock], Policy]


def make_leader(spec: StationSpec, clock: Clock) -> Leader:
    """Return the leader of a deployment that relays a leader, not yet connected.

    Raises:
        ConfigurationError: the deployment has no leader.
    """
    collection = spec.deployment.collection
    if collection is None or collection.leader is None:
        raise ConfigurationError("this deployment has no [collection.leader]")
    kind = variants("runtime.teleoperators")[collection.leader.kind]
    leader: Leader = kind.build(collection.leader, spec.robot, clock)
    return leader


def make_policy(
    spec: StationSpec,
    clock: Clock,
    build: Callable[[Any, Robot, Clock, float], Policy] | None = None,
    leader: Callable[[StationSpec, Clock], Leader] = make_leader,
) -> Policy:
    """Return the policy, not yet connected.

    Args:
        spec: the station.
        clock: the clock of the policy.
        build: replaces the builder of the policy's kind.
        leader: replaces the builder of the deployment's leader.

    Raises:
        RuntimeFault: the policy does not fit the robot, or cannot be built.
    """
    if spec.collecting:
        return _leader_policy(spec, clock, leader)
    settings = spec.deployment.policy
    try:
        build = build or variants("runtime.policies")[settings.kind].build
        return through_tunnel(build(settings, spec.robot, clock, spec.rate), settings)
    except RuntimeFault:
        raise
    except Exception as error:  # of the policy's own code; the coordinator must survive it
        logging.getLogger(__name__).exception("the policy's own code failed")
        raise ConfigurationError(
            f"policy {settings.kind!r} cannot be created: {type(error).__name__}: {error}"
        ) from error


def _leader_policy(spec: StationSpec, clock: Clock, leader: Callable[[StationSpec, Clock], Leader]) -> Policy:
    """Return the policy that is queried while the operator drives the robot."""
    from runtime.teleoperators.leader_policy import LeaderPolicy, NodeDrivenPolicy

    collection = spec.deployment.collection
    if collection is None:
        raise ConfigurationError("this deployment has no [collection]: there is no leader")
    if collection.source == "node":
        return NodeDrivenPolicy()
    return LeaderPolicy(
        leader(spec, clock),
        spec.robot,
        collection.mode,
        collection.max_age_s,
        spec.rate,
        clock,
        spec.deployment.safety.steady_error,
    )


def make_kinematics(spec: StationSpec) -> Kinematics:
    """Return forward and inverse kinematics of the robot, completely compiled and loaded."""
    settings = spec.deployment.kinematics
    kinematics: Kinematics = variants("runtime.kinematics")[settings.kind].build(settings, spec.robot)
    return kinematics


def kinematics_compiled(spec: StationSpec) -> bool:
    """Return True if `make_kinematics` would have nothing to compile."""
    backend = variants("runtime.kinematics")[spec.deployment.kinematics.kind]
    return bool(backend.is_compiled(spec.robot))
