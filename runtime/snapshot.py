"""What clients are shown of a station: one whole map, never differences."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from runtime.family import Plan
from runtime.inference import Inference
from runtime.lease import Lease
from runtime.messages import MediaReport
from runtime.page import Page
from runtime.runs import Runs
from runtime.session import Session
from runtime.setup import SetUp


@dataclass(frozen=True, slots=True)
class View:
    """The parts of main that a snapshot shows, at the moment `now` of the runtime's clock."""

    plan: Plan
    page: Page
    session: Session
    lease: Lease
    inference: Inference
    setup: SetUp
    runs: Runs
    media: MediaReport
    estop: str
    boot: str
    now: float
    newest_event: int
    facts: Mapping[str, Any]  # as by `facts`, which never change


def snapshot(view: View) -> dict[str, Any]:
    """The station's state; times in seconds on the runtime's clock, ages in seconds."""
    settings, session = view.plan.deployment, view.session
    return {
        "boot": view.boot,
        "sequence": session.sequence,
        "clock": view.now,
        "station": settings.station,
        "robot": view.plan.robot.name,
        "state": str(session.state),
        "reason": session.reason,
        "allowed": session.allowed(),
        "stage": str(view.setup.stage),
        "validated": view.setup.validated,
        "task": settings.task,
        "checkpoint": dict(view.runs.provenance.checkpoint),
        "simulated": view.plan.capabilities.resets_bench,
        "truth": dict(view.media.truth),
        "transport": settings.transport.kind,
        "policy": {"kind": settings.policy.kind, **_inference(view)},
        "strategy": settings.strategy.kind,
        "lease": _lease(view),
        "estop": view.estop,
        "run": _run(view),
        "last_run": view.runs.last,
        "recording": {
            "uuid": view.media.recording,
            "rows": view.media.rows,
            "repeated": view.media.repeated,
        },
        "episode": view.runs.last_episode,
        "control": control_figures(view.page, view.plan.rate),
        "link": _link(view),
        "newest_event": view.newest_event,
        "facts": dict(view.facts),
    }


def facts(plan: Plan) -> dict[str, Any]:
    """What never changes while a station runs: names, sizes, limits [rad or the gripper's unit], rates [Hz]."""
    robot, bus = plan.robot, plan.deployment.bus
    return {
        "robot": robot.name,
        "joint_names": list(robot.joint_names),
        "arms": [arm.name for arm in robot.arms],
        "eef_names": list(robot.eef_names),
        "gripper_dims": list(robot.gripper_dims),
        "lower": robot.lower.tolist(),
        "upper": robot.upper.tolist(),
        "home": robot.poses[plan.deployment.setup.pose].tolist(),
        "poses": sorted(robot.poses),
        "cameras": list(plan.cameras),
        "rate": plan.rate,
        "fps": plan.fps,
        "preview_rate": bus.preview_rate,
        "recorded": plan.deployment.recording.enabled,
        "lease_ttl_s": plan.deployment.lease.ttl_s,
    }


def _lease(view: View) -> dict[str, Any]:
    held = view.lease.current(view.now)
    if held is None:
        return {"holder": "", "epoch": view.lease.epoch, "expires_in": 0.0}
    return {"holder": held.holder, "epoch": held.epoch, "expires_in": held.until - view.now}


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
    latencies, delays = view.inference.latencies, view.inference.delays
    return {
        "name": view.setup.info.name if view.setup.info else "",
        "answers": len(latencies),
        "latency_p50_ms": quantile(latencies, 50) * 1000,
        "latency_p90_ms": quantile(latencies, 90) * 1000,
        "delay_p50": quantile(delays, 50),
        "delay_max": max(delays, default=math.nan),
    }


def quantile(values: Sequence[float], percent: float) -> float:
    """The percentile of `values`, NaN where there are none."""
    return float(np.percentile(np.array(values), percent)) if values else math.nan


def control_figures(page: Page, rate: float) -> dict[str, Any]:
    """What control last did and how well it keeps time."""
    status = page.control.read()
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
        "lateness_max_ms": float(status["lateness_max"]) * 1000,
        "scheduling": bytes(status["scheduling"]).decode(),
        "records_lost": int(status["records_lost"]),
    }


def _link(view: View) -> dict[str, Any]:
    record = view.page.observation.read()
    never = int(record["sequence"]) == 0
    ages = {"joints": math.inf if never else view.now - float(record["joints_captured"])}
    for index, camera in enumerate(view.page.layout.cameras):
        seen = bool(record["picture_number"][index])
        ages[camera] = view.now - float(record["picture_captured"][index]) if seen else math.inf
    return {"ages": ages, "rates": dict(view.media.rates), "faults": dict(view.media.faults)}
