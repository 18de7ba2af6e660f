"""Snapshot of a station for its clients: one whole map, never differences."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np

from robots.units import units_of
from runtime.core.plugins import variants
from runtime.core.types import Float64
from runtime.ipc.messages import MediaReport, PolicyMode, ReceptionReport
from runtime.ipc.session_state import SessionState
from runtime.ipc.shared_state import SharedState
from runtime.processes.coordinator.demonstrations import Demonstrations
from runtime.processes.coordinator.inference.inference import Inference
from runtime.processes.coordinator.lease import Lease
from runtime.processes.coordinator.manual.manual_control import ManualControl
from runtime.processes.coordinator.runs import Runs
from runtime.processes.coordinator.session.machine import SessionMachine
from runtime.processes.coordinator.setup.sequence import SetUp, Stage, first_action
from runtime.station.spec import StationSpec


@dataclass(frozen=True, slots=True)
class View:
    """The parts of the coordinator that a snapshot shows, at the moment `now` of the runtime's clock."""

    spec: StationSpec
    shared: SharedState
    session: SessionMachine
    lease: Lease
    inference: Inference
    setup: SetUp
    runs: Runs
    media: MediaReport
    reception: ReceptionReport
    unheard: Mapping[str, str]  # as by Sink.unheard
    manual: ManualControl
    collecting: Demonstrations
    estop: str
    boot: str
    now: float
    people: float  # the same moment on the clock of leases and commands
    newest_event: int
    facts: Mapping[str, Any]  # as by `facts`, which never change


def snapshot(view: View) -> dict[str, Any]:
    """The station's state; times in seconds on the runtime's clock, ages in seconds.

    "clock" is the one that commands are valid by; in lockstep it goes on while the runtime's stands.
    """
    settings, session = view.spec.deployment, view.session
    return {
        "boot": view.boot,
        "sequence": session.sequence,
        "clock": view.people,
        "station": settings.station,
        "robot": view.spec.robot.name,
        "state": str(session.state),
        "state_is": session.state.told(),
        "reason": session.reason,
        "allowed": session.allowed(),
        "guarded": session.guarded(),
        "mode": view.runs.open.mode if view.runs.open else settings.run.mode,
        "sim_state": "simulated" if view.inference.requests.policy_observation.simulated else "live",
        "phase": _phase(view),
        "stage": str(view.setup.stage),
        "stages": _stages(view),
        "setup_took": dict(view.setup.took),
        "first_action": _first_action(view),
        "proposal": _proposal(view),
        "grippers": view.manual.grippers.told(view.manual.commanded()),
        "drives": dict(view.reception.drives),
        "collect": view.collecting.shown(),
        "validated": view.setup.validated,
        "task": settings.task,
        "checkpoint": dict(view.runs.checkpoint),
        "simulated": view.spec.capabilities.resets_bench,
        "truth": dict(view.reception.truth),
        "transport": settings.transport.kind,
        "policy": {"kind": settings.policy.kind, **_inference(view)},
        "strategy": settings.strategy.kind,
        "tuning": settings.strategy.model_dump(),
        "lease": _lease(view),
        "estop": view.estop,
        "run": _run(view),
        "last_run": view.runs.last,
        "recording": {
            "uuid": view.media.recording,
            "rows": view.media.rows,
            "repeated": view.media.repeated,
            "unclosed": dict(view.media.unclosed),
        },
        "episode": view.runs.last_episode,
        "control": control_figures(view.shared, view.spec.rate),
        "link": _link(view),
        "newest_event": view.newest_event,
        "facts": dict(view.facts),
    }


def facts(spec: StationSpec) -> dict[str, Any]:
    """Constants of a running station: names, sizes, limits [rad or the gripper's unit], rates [Hz]."""
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
    }


def _lease(view: View) -> dict[str, Any]:
    held = view.lease.current(view.people)
    if held is None:
        return {"holder": "", "by": "", "epoch": view.lease.epoch, "expires_in": 0.0}
    left = held.until - view.people
    return {"holder": held.holder, "by": held.by, "epoch": held.epoch, "expires_in": left}


def _run(view: View) -> dict[str, Any]:
    run = view.runs.open
    if run is None:
        return {"number": 0, "uuid": "", "elapsed": 0.0, "held": 0.0, "duration_s": None}
    held = run.held + (view.now - run.held_since if run.held_since is not None else 0.0)
    return {
        "number": run.number,
        "uuid": run.uuid,
        "elapsed": run.elapsed(view.now),
        "held": held,
        "duration_s": run.duration_s,
    }


def _inference(view: View) -> dict[str, Any]:
    metrics = view.inference.metrics
    return {
        "name": view.setup.info.name if view.setup.info else "",
        "answers": metrics.answers,
        **metrics.newest(),
        "lost": view.inference.lost_for > 0,
        "retry_in_s": view.inference.retry_in,
        "rtc": view.inference.rtc,
    }


def _phase(view: View) -> str:
    """Phase of a run that goes on, in one word; "" where none does, or it has not begun."""
    run, control = view.runs.open, view.shared.control.read()
    if run is None or run.begun is None or view.session.state is not SessionState.RUNNING:
        return ""
    moving = bytes(control["behaviour"]) == b"motion"
    states = (
        ("approaching", run.approaching),
        ("moving", moving),
        ("proposed", view.inference.proposal is not None),
        ("executing", int(control["remaining"]) > 0),
        ("starved", bool(control["starved"])),
        ("asking", view.inference.asked),
    )
    return next((word for word, holds in states if holds), "waiting")


_SETUP_STAGES = (Stage.CONNECT, Stage.OBSERVE, Stage.HOME, Stage.SETTLE, Stage.RESET, Stage.WARM_UP)


def _stages(view: View) -> list[dict[str, Any]]:
    """The stages of the newest set-up in their order: what is done, what goes on and for how long, what failed."""
    setup = view.setup
    entered = setup.stages
    names = _SETUP_STAGES if Stage.CONNECT in entered or not entered else tuple(entered)
    told = []
    for stage in names:
        since = entered.get(stage)
        later = [
            at for other, at in entered.items() if since is not None and other is not stage and at >= since
        ]
        if stage is setup.stage:
            state = "active"
        elif stage is setup.failed:
            state = "failed"
        elif since is not None:
            state = "done"
        else:
            state = "waiting" if setup.active or not entered else "skipped"
        seconds = 0.0 if since is None else (min(later) if later else view.now) - since
        told.append({"name": str(stage), "state": state, "seconds": seconds if state != "waiting" else 0.0})
    return told


def _first_action(view: View) -> dict[str, Any]:
    """Distance of the policy's first action from where the robot is now; {} where it is not known."""
    if view.setup.first_action is None:
        return {}
    return first_action(view.setup.first_action, _joints(view), view.spec)


def _proposal(view: View) -> dict[str, Any]:
    """The chunk that is shown and waits to be committed."""
    made = view.inference.proposal
    if made is None:
        return {}
    first = first_action(made.answered.made.meant, _joints(view), view.spec)
    age = view.now - made.answered.observation.captured.get("joints", view.now)
    return {"chunk": made.number, "rows": len(made.rows), "age_s": age, **first}


def _joints(view: View) -> Float64:
    return np.array(view.shared.observation.read()["qpos"], np.float64)


def control_figures(shared: SharedState, rate: float) -> dict[str, Any]:
    """Figures of control: what it last did and how well it keeps time."""
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


def _link(view: View) -> dict[str, Any]:
    record = view.shared.observation.read()
    never = int(record["sequence"]) == 0
    ages = {"joints": math.inf if never else view.now - float(record["joints_captured"])}
    for index, camera in enumerate(view.shared.layout.cameras):
        seen = bool(record["picture_number"][index])
        ages[camera] = view.now - float(record["picture_captured"][index]) if seen else math.inf
    return {
        "ages": ages,
        "rates": dict(view.reception.rates),
        "faults": dict(view.reception.faults),
        "cameras": {key: dict(told) for key, told in view.reception.cameras.items()},
        "unheard": dict(view.unheard),
        "age_ms": dict(view.reception.age_ms),
        "scheduling": view.reception.scheduling,
    }
