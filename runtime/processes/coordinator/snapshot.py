"""Snapshot of a station for its clients: one complete map, never differences."""

from __future__ import annotations

import math
from typing import Any, get_args

from robots import Robot
from robots.units import units_of
from runtime.benches.appearance import describe_appearance
from runtime.benches.schema import load_schema
from runtime.core.plugins import variants
from runtime.core.sentences import within
from runtime.ipc.messages import PolicyMode
from runtime.ipc.session_state import SessionState
from runtime.ipc.shared_state import SharedState
from runtime.lerobot.features import JointFeature
from runtime.processes.coordinator.components import Components
from runtime.processes.coordinator.inbox import Inbox
from runtime.station.spec import StationSpec


def build_snapshot(of: Components, inbox: Inbox) -> dict[str, Any]:
    """Return the station's state; times in seconds on the runtime's clock, ages in seconds.

    "clock" is the clock of command validity; in lockstep it continues while the runtime's clock is stopped. "sentences"
    maps the path of each translatable text in the snapshot, such as "reason" or "guarded.run", to the text's id and
    arguments.
    """
    snapshot = _snapshot(of, inbox)
    changing = {key: value for key, value in snapshot.items() if key != "facts"}
    return snapshot | {"sentences": within(changing)}


def _snapshot(of: Components, inbox: Inbox) -> dict[str, Any]:
    spec, settings = of.spec, of.spec.deployment
    now, people = of.clock.now(), of.client_clock.now()
    media, reception = inbox.media_report, inbox.reception_report
    return {
        "boot": of.boot,
        "clock": people,
        "station": settings.station,
        "robot": spec.robot.name,
        **of.session.status(),
        "mode": of.runs.open.mode if of.runs.open else settings.run.mode,
        "sim_state": "simulated" if of.inference.simulated else "live",
        "phase": _phase(of),
        **of.setup.status(now),
        "proposal": _proposal(of, now),
        **of.manual.status(),
        "drives": dict(reception.drives),
        "collect": of.collecting.status(),
        "task": settings.task,
        "simulated": bool(spec.capabilities.bench),
        "truth": dict(reception.truth),
        "transport": settings.transport.kind,
        "policy": {
            "kind": settings.policy.kind,
            "name": of.setup.info.name if of.setup.info else "",
            **of.inference.status(),
        },
        "strategy": settings.strategy.kind,
        "tuning": settings.strategy.model_dump(),
        "lease": of.lease.status(people),
        "estop": of.health.estop,
        **of.runs.status(now),
        "recording": {
            "uuid": media.recording,
            "rows": media.rows,
            "repeated": media.repeated,
            "unclosed": dict(media.unclosed),
        },
        "control": control_figures(of.shared, spec.rate),
        "link": _link(of, inbox, now),
        "newest_event": of.events.newest,
        "facts": dict(of.facts),
    }


def station_facts(spec: StationSpec) -> dict[str, Any]:
    """Return constants of a running station: names, sizes, limits [rad or the gripper's unit], rates [Hz]."""
    robot, bus = spec.robot, spec.deployment.bus
    return {
        "robot": robot.name,
        "groups": [group.name for group in robot.groups],
        "joint_names": list(robot.joint_names),
        "units": list(units_of(robot)),
        "arms": [arm.name for arm in robot.arms],
        "eef_names": list(robot.eef_names),
        "gripper_dims": list(robot.gripper_dims),
        "lower": robot.lower.tolist(),
        "upper": robot.upper.tolist(),
        "home": robot.poses[spec.deployment.setup.pose].tolist(),
        "velocity": robot.velocity.tolist(),
        "binary_dims": list(robot.binary_dims),
        "poses": sorted(robot.poses),
        "tasks": list(dict.fromkeys(filter(None, [spec.deployment.task, *spec.deployment.tasks]))),
        "strategies": {kind: sorted(module.USES) for kind, module in variants("runtime.strategies").items()},
        "strategy": spec.deployment.strategy.model_dump(),
        "modes": list(get_args(PolicyMode)),
        "moves_robot": spec.capabilities.moves_robot,
        "cameras": list(spec.cameras),
        "rate": spec.rate,
        "fps": spec.fps,
        "preview_rate": bus.preview_rate,
        "recorded": spec.deployment.recording.enabled,
        "lease_ttl_s": spec.deployment.lease.ttl_s,
        "lerobot": _lerobot_features(robot),
        "bench": describe_appearance(load_schema(spec.capabilities.bench))
        if spec.capabilities.bench
        else None,
    }


def _lerobot_features(robot: Robot) -> list[list[Any]] | None:
    """Return LeRobot's feature, scale and offset of each joint; None if the description lacks one."""
    if robot.lerobot is None:
        return None
    tables = robot.lerobot.joints
    features = []
    for group in robot.groups:
        for joint in group.joints:
            if joint not in tables.get(group.name, {}):
                return None
            table = tables[group.name][joint].model_dump(exclude_none=True)
            feature = JointFeature.from_table(joint, table)
            features.append([feature.feature, feature.scale, feature.offset])
    return features


def _phase(of: Components) -> str:
    """Return the phase of a run in one word; "" if no run has begun or the session is not running."""
    run, control = of.runs.open, of.shared.control.read()
    if run is None or run.begun_at is None or of.session.state is not SessionState.RUNNING:
        return ""
    moving = bytes(control["behaviour"]) == b"motion"
    states = (
        ("approaching", run.is_approaching),
        ("moving", moving),
        ("proposed", of.inference.proposal is not None),
        ("executing", int(control["remaining"]) > 0),
        ("starved", bool(control["starved"])),
        ("asking", of.inference.is_pending),
    )
    return next((word for word, holds in states if holds), "waiting")


def _proposal(of: Components, now: float) -> dict[str, Any]:
    """Return the status of the chunk that waits to be committed, {} if there is none."""
    proposal = of.inference.proposal
    return (
        {}
        if proposal is None
        else {**proposal.status(now), **of.setup.distance_of(proposal.commands.intended_start)}
    )


def control_figures(shared: SharedState, rate: float) -> dict[str, Any]:
    """Return control's status figures: its last tick and its timing."""
    status = shared.control.read()
    return {
        "rate": rate,
        "step": int(status["step"]),
        "behaviour": bytes(status["behaviour"]).decode(),
        "engaged": bool(status["engaged"]),
        "remaining": int(status["remaining"]),
        "ticks": int(status["ticks"]),
        "missed": int(status["missed"]),
        "lateness_p50_ms": float(status["lateness_p50"]) * 1000,
        "lateness_p99_ms": float(status["lateness_p99"]) * 1000,
        "lateness_p999_ms": float(status["lateness_p999"]) * 1000,
        "lateness_max_ms": float(status["lateness_max"]) * 1000,
        "scheduling": bytes(status["scheduling"]).decode(),
        "records_lost": int(status["records_lost"]),
    }


def _link(of: Components, inbox: Inbox, now: float) -> dict[str, Any]:
    record, reception = of.shared.observation.read(), inbox.reception_report
    never = int(record["sequence"]) == 0
    ages = {"joints": math.inf if never else now - float(record["joints_captured"])}
    sizes: dict[str, list[int]] = {}  # height, width of the newest picture
    for index, camera in enumerate(of.shared.layout.cameras):
        received = bool(record["picture_number"][index])
        ages[camera] = now - float(record["picture_captured"][index]) if received else math.inf
        size = of.shared.pictures[camera].shape(int(record["picture_number"][index])) if received else None
        if size is not None:
            sizes[camera] = [int(size[0]), int(size[1])]
    return {
        "ages": ages,
        "picture_sizes": sizes,
        "rates": dict(reception.rates),
        "faults": dict(reception.faults),
        "cameras": {key: dict(status) for key, status in reception.cameras.items()},
        "unheard": dict(inbox.unheard),
        "age_ms": dict(reception.age_ms),
        "scheduling": reception.scheduling,
    }
