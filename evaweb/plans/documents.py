"""The frozen form of a plan: all that its trials depend on, whatever becomes of scenes and checkpoints later."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

from evaweb.plans.design import drafted
from evaweb.plans.models import Plan
from evaweb.plans.schedule import Condition, Unit, schedule
from evaweb.statistics.designs import table
from evaweb.trials.models import Checkpoint, Position, Scene

FORMAT = 3  # 2 had no outcome, margin, looks or boundary


def document_of(plan: Plan) -> dict[str, Any]:
    """All that is frozen of a draft, in plain JSON."""
    positions: dict[Scene, list[Position]] = defaultdict(list)
    for position in plan.positions.select_related("scene").order_by("scene__name", "number"):
        positions[position.scene].append(position)
    return {
        "format": FORMAT,
        "name": plan.name,
        "version": plan.version,
        "title": plan.title,
        "question": plan.question,
        "owner": plan.owner.get_username(),
        "scenes": [scene_of(scene, chosen) for scene, chosen in positions.items()],
        "checkpoints": [checkpoint_of(row) for row in plan.checkpoints.order_by("name")],
        "repetitions": plan.repetitions,
        "stations": list(plan.stations.order_by("name").values_list("name", flat=True)),
        "mode": "continuous",
        "strategy": plan.strategy,
        "blind": plan.blind,
        "stopping": {"rule": plan.stopping, "alpha": plan.alpha, **_design(plan)},
        "comparison": [plan.first.name, plan.second.name] if plan.first and plan.second else None,
        "second_rater_share": plan.second_rater_share,
        "match_gate": plan.match_gate,
    }


def _design(plan: Plan) -> dict[str, Any]:
    found = drafted(plan)
    return {
        "outcome": plan.outcome,
        "margin": plan.margin,
        "pairs": found.pairs if found else None,
        "boundary": table(found.boundary) if found and found.boundary else None,
    }


def scene_of(scene: Scene, positions: list[Position]) -> dict[str, Any]:
    """A scene with those of its positions that are used, and all its milestones."""
    return {
        "name": scene.name,
        "title": scene.title,
        "instruction": scene.instruction,
        "criterion": scene.criterion,
        "layout": scene.layout,
        "time_limit_s": scene.time_limit_s,
        "ordered": scene.ordered,
        "positions": [
            {"number": p.number, "label": p.label, "description": p.description, "bench": p.bench}
            for p in positions
        ],
        "milestones": [
            {
                "order": m.order,
                "text": m.text,
                "points": m.points,
                "required": m.required,
                "time_limit_s": m.time_limit_s,
                "truth": m.truth,
            }
            for m in scene.milestones.order_by("order")
        ],
    }


def checkpoint_of(checkpoint: Checkpoint) -> dict[str, Any]:
    """A checkpoint: how it is reached, and its weights where they have a digest."""
    weights = {"digest": checkpoint.digest} if checkpoint.digest else {}
    return {
        "name": checkpoint.name,
        "description": checkpoint.description,
        "policy": checkpoint.policy,
        **weights,
    }


def conditions_of(document: dict[str, Any]) -> list[Condition]:
    """The initial conditions of a frozen plan."""
    return [
        Condition(scene["name"], position["number"])
        for scene in document["scenes"]
        for position in scene["positions"]
    ]


def units_of(plan: Plan) -> list[Unit]:
    """The schedule of a frozen plan, drawn by its key."""
    document = plan.document or {}
    return schedule(
        checkpoints=[row["name"] for row in document["checkpoints"]],
        conditions=conditions_of(document),
        repetitions=document["repetitions"],
        key=bytes(plan.key or b""),
    )
