"""Arguments of a command over the bus, from the command line; omitted options are left out."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any


def arguments(given: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments of a command that can be built from the command line alone, without the station."""
    build = _BUILDERS.get(given.command)
    return {} if build is None else _without_none(build(given))


def _setup(given: argparse.Namespace) -> dict[str, Any]:
    policy = dict(given.policy or []) | _without_none({"url": given.policy_url})
    return {
        "policy": policy or None,
        "strategy": None if given.strategy is None else {"kind": given.strategy},
        "task": given.task,
        "checkpoint": None
        if given.checkpoint is None
        else {"id": given.checkpoint, "name": given.checkpoint},
        "bench": None if given.bench_seed is None else {"seed": given.bench_seed},
        "collect": given.collect,
    }


def _run(given: argparse.Namespace) -> dict[str, Any]:
    return {
        "mode": given.mode,
        "sim_state": given.sim_state,
        "duration_s": given.duration,
        "operator": given.operator,
        "task": given.task,
    }


def _label(given: argparse.Namespace) -> dict[str, Any]:
    return {"result": given.result, "note": given.note, "episode": given.episode}


def _discard(given: argparse.Namespace) -> dict[str, Any]:
    return {"episode": given.episode}


def _gripper(given: argparse.Namespace) -> dict[str, Any]:
    return {"action": given.action, "arm": given.arm}


def _tune(given: argparse.Namespace) -> dict[str, Any]:
    strategy = dict(given.set or []) | _without_none({"kind": given.strategy})
    return {"strategy": strategy or None, "task": given.task}


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
