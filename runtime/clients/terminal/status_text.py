"""Text of a station's snapshot: one line for its activity, a report for all of its state."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any


def status_line(status: Mapping[str, Any], me: str | None = None) -> str:
    """Return the status in one line; if `me` is given, a lease of a holder other than `me` is named too."""
    parts = [_headline(status), *_run_figures(status), *_tick_figures(status)]
    holder = status["lease"]["holder"]
    if me is not None and holder not in ("", me):
        parts.append(f"lease: {holder}")
    return "  ".join(parts)


def _headline(status: Mapping[str, Any]) -> str:
    state, state_is = status["state"], status["state_is"]
    doing = ""
    if state_is["preparing"]:
        doing = f" ({status['stage']})"
    elif state_is["run_open"]:
        doing = f" ({status['mode']}{', ' if status['phase'] else ''}{status['phase']})"
    reason = f": {status['reason']}" if status["reason"] else ""
    return f"{state.upper()}{doing}{reason}"


def _run_figures(status: Mapping[str, Any]) -> list[str]:
    parts = []
    if status["run"]["number"]:
        parts.append(f"{status['run']['elapsed']:.1f} s")
    if status["recording"]["uuid"]:
        parts.append(f"{status['recording']['rows']} rows")
    policy = status["policy"]
    if not math.isnan(policy["latency_p50_ms"]):
        parts.append(f"policy {policy['latency_p50_ms']:.0f} ms, delay {format_figure(policy['delay_p50'])}")
    if policy["lost"]:
        parts.append("policy lost")
    return parts


def _tick_figures(status: Mapping[str, Any]) -> list[str]:
    control = status["control"]
    parts = [f"tick p99 {control['lateness_p99_ms']:.2f} ms, {control['missed']} missed"]
    rates = [rate for name, rate in status["link"]["rates"].items() if name not in ("joints", "eef")]
    if rates:
        parts.append(f"cameras {min(rates):.0f} Hz")  # slowest camera
    return parts


def format_figure(value: float) -> str:
    """Return the figure as a whole number, or as a dash if it has not been measured."""
    return "-" if math.isnan(value) else f"{value:.0f}"


def status_report(status: Mapping[str, Any], me: str) -> list[str]:
    """Return the state of the station, as lines."""
    rows = [
        ("lease", _lease(status["lease"], me)),
        ("robot", f"{status['robot']} over {status['transport']}"),
        ("drives", drive_line(status["drives"])),
        ("grippers", _grippers(status["grippers"])),
        ("task", status["task"] or "none"),
        ("policy", _policy(status["policy"])),
        ("strategy", ", ".join(tuning_lines(status)) or status["strategy"]),
        ("mode", _mode(status)),
        ("first", distance_text(status["first_action"], "the policy's first action")),
        ("chunk", distance_text(status["proposal"], "the chunk that is shown")),
        ("recording", status["recording"]["uuid"] or "none"),
        *(
            ("unclosed", f"{uuid}: {reason}")
            for uuid, reason in status["recording"].get("unclosed", {}).items()
        ),
        ("allowed", ", ".join(status["allowed"])),
    ]
    return [status_line(status), *(f"  {name:<9} {text}" for name, text in rows if text)]


def _lease(lease: Mapping[str, Any], me: str) -> str:
    if not lease["holder"]:
        return "free"
    whose = "yours" if lease["holder"] == me else lease["holder"]
    return f"{whose}, for {lease['expires_in']:.1f} s unless it is renewed"


def drive_line(said: Mapping[str, Any]) -> str:
    """Return a line about the state of the drives.

    `said` is the state as the execution node reports it, and is empty if the node does not report it.
    """
    if not said:
        return "not reported by the node"
    faults = "".join(f"; fault: {fault}" for fault in said["faults"])
    return ("enabled" if said["enabled"] else "DISABLED") + faults


def _grippers(grippers: Mapping[str, Any]) -> str:
    return ", ".join(
        f"{arm} {gripper['at']:.3f}{' locked' if gripper['locked'] else ''}"
        for arm, gripper in grippers.items()
    )


def _policy(policy: Mapping[str, Any]) -> str:
    parts = [f"{policy['kind']} {policy['name']}".strip()]
    if policy["answers"]:
        latency = f"p50 {policy['latency_p50_ms']:.0f} ms, p90 {policy['latency_p90_ms']:.0f} ms"
        parts.append(f"{policy['answers']} answers, {latency}")
        parts.append(
            f"delay {format_figure(policy['delay_p50'])} ticks, at most {format_figure(policy['delay_max'])}"
        )
    if policy["lost"]:
        parts.append(f"LOST, asked again in {policy['retry_in_s']:.1f} s")
    if policy["rtc"].get("warning"):
        parts.append(policy["rtc"]["warning"])
    return "; ".join(parts)


def _mode(status: Mapping[str, Any]) -> str:
    sees = f", the policy sees the {status['sim_state']} state" if status["mode"] == "sim" else ""
    return f"{status['mode']}{sees}" + (f", {status['phase']}" if status["phase"] else "")


def distance_text(found: Mapping[str, Any], what: str) -> str:
    """Return a text about how far the robot is from an action; "" if `found` is empty, because there is no action.

    Args:
        found: Entry of the status with the distance, the joint, and whether that is too far.
        what: Name of the action in the text.
    """
    if not found:
        return ""
    far = ": FAR, approach it first" if found["far"] else ""
    return f"{what} is {found['distance']:.3f} rad away ({found['joint']}){far}"


def tuning_lines(status: Mapping[str, Any], everything: bool = False) -> list[str]:
    """Return the strategy in force and its parameters as lines.

    With `everything`, parameters that this strategy does not use are included.
    """
    in_force = status["tuning"]
    uses = status["facts"]["strategies"].get(in_force["kind"], [])
    parts = [in_force["kind"]]
    for name, value in in_force.items():
        if name == "kind" or not (everything or name in uses):
            continue
        text = "none" if value is None else value
        parts.append(f"{name} {text}" + ("" if name in uses else f" (nothing to {in_force['kind']})"))
    return parts
