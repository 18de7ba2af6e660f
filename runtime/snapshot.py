"""What clients are shown of a station: one whole map, never differences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from runtime.main import Main


def snapshot(main: Main) -> dict[str, Any]:
    """The station's state at this moment; times in seconds on the runtime's clock, ages in seconds."""
    now = main.clock.now()
    session = main.session
    return {
        "boot": main.boot,
        "sequence": session.sequence,
        "clock": now,
        "station": main.plan.deployment.station,
        "robot": main.plan.robot.name,
        "state": str(session.state),
        "reason": session.reason,
        "allowed": session.allowed(),
        "stage": str(main.setup.stage),
        "validated": main.setup.validated,
        "task": main.plan.deployment.task,
        "transport": main.plan.deployment.transport.kind,
        "policy": {"kind": main.plan.deployment.policy.kind, **_inference(main)},
        "strategy": main.plan.deployment.strategy.kind,
        "lease": _lease(main, now),
        "estop": main.estop_sentence,
        "run": _run(main, now),
        "recording": _recording(main),
        "episode": main.last_episode,
        "control": _control(main),
        "link": _link(main, now),
        "newest_event": main.events.newest,
    }


def _lease(main: Main, now: float) -> dict[str, Any]:
    held = main.lease.current(now)
    if held is None:
        return {"holder": "", "epoch": main.lease.epoch, "expires_in": 0.0}
    return {"holder": held.holder, "epoch": held.epoch, "expires_in": held.until - now}


def _recording(main: Main) -> dict[str, Any]:
    report = main.media_report
    return {"uuid": report.recording, "rows": report.rows, "repeated": report.repeated}


def _run(main: Main, now: float) -> dict[str, Any]:
    run = main.run
    if run is None:
        return {"number": 0, "uuid": "", "elapsed": 0.0, "held": 0.0}
    held = run.held + (now - run.held_since if run.held_since is not None else 0.0)
    return {"number": run.number, "uuid": run.uuid, "elapsed": run.elapsed(now), "held": held}


def _inference(main: Main) -> dict[str, Any]:
    latencies, delays = main.inference.latencies, main.inference.delays
    return {
        "name": main.setup.info.name if main.setup.info else "",
        "answers": len(latencies),
        "latency_p50_ms": quantile(latencies, 50) * 1000,
        "latency_p90_ms": quantile(latencies, 90) * 1000,
        "delay_p50": quantile(delays, 50),
        "delay_max": max(delays, default=math.nan),
    }


def quantile(values: Sequence[float], percent: float) -> float:
    """The percentile of `values`, NaN where there are none."""
    return float(np.percentile(np.array(values), percent)) if values else math.nan


def _control(main: Main) -> dict[str, Any]:
    status = main.page.control.read()
    return {
        "rate": main.plan.rate,
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


def _link(main: Main, now: float) -> dict[str, Any]:
    record = main.page.observation.read()
    never = int(record["sequence"]) == 0
    ages = {"joints": math.inf if never else now - float(record["joints_captured"])}
    for index, camera in enumerate(main.page.layout.cameras):
        seen = bool(record["picture_number"][index])
        ages[camera] = now - float(record["picture_captured"][index]) if seen else math.inf
    report = main.media_report
    return {"ages": ages, "rates": dict(report.rates), "faults": dict(report.faults)}
