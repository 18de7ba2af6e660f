"""Arguments of a command over the bus, from the command line; omitted options are left out."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any


def arguments(given: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments of a command that can be built from the command line alone, without the station."""
    build = _BUILDERS.get(given.command)
    return {} if build is None else _without_none(build(given))


def _setup(options: argparse.Namespace) -> dict[str, Any]:
    policy = dict(options.policy or []) | _without_none({"url": options.policy_url})
    return {
        "policy": policy or None,
        "strategy": None if options.strategy is None else {"kind": options.strategy},
        "task": options.task,
        "checkpoint": None
        if options.checkpoint is None
        else {"id": options.checkpoint, "name": options.checkpoint},
        "bench": None if options.bench_seed is None else {"seed": options.bench_seed},
        "collect": options.collect,
    }


def _run(options: argparse.Namespace) -> dict[str, Any]:
    return {
        "mode": options.mode,
        "sim_state": options.sim_state,
        "duration_s": options.duration,
        "operator": options.operator,
        "task": options.task,
    }


def _label(options: argparse.Namespace) -> dict[str, Any]:
    return {"result": options.result, "note": options.note, "episode": options.episode}


def _discard(options: argparse.Namespace) -> dict[str, Any]:
    return {"episode": options.episode}


def _gripper(options: argparse.Namespace) -> dict[str, Any]:
    return {"action": options.action, "arm": options.arm}


def _tune(options: argparse.Namespace) -> dict[str, Any]:
    strategy = dict(options.set or []) | _without_none({"kind": options.strategy})
    return {"strategy": strategy or None, "task": options.task}


_BUILDERS = {
    "setup": _setup,
    "run": _run,
    "gripper": _gripper,
    "tune": _tune,
    "label": _label,
    "discard": _discard,
}


def _without_none(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}
