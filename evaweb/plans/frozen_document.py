"""Frozen form of a plan: everything that its trials depend on, independent of later changes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import Any

from evaweb.core.canonical_json import digest
from evaweb.core.errors import Conflict, EvaError
from evaweb.plans.counting import ENDS
from evaweb.plans.design import draft_design, planned
from evaweb.plans.models import Allocation, Plan
from evaweb.plans.schedule import PAIRED, Condition, Unit, counts_of, schedule
from evaweb.statistics.boundaries import MOST, SHAPES
from evaweb.statistics.designs import boundary_table
from evaweb.trials.models import Checkpoint, Position, Scene
from runtime.benches.schema import DEFAULT_BENCH
from runtime.core.sentences import Pattern

_RANDOM_ORDER_TWO_CHECKPOINTS_CAME = Pattern(
    "plans.documents.random_order_two_checkpoints_came",
    "in random order two checkpoints came to {made} and {made_2} trials; allowed: 1 to {most} of each: "
    "plan {which} of them",
)

_SCENE_RENAMED_SINCE_FROZEN = Pattern(
    "plans.documents.scene_renamed_since_frozen",
    "a scene was renamed since {plan} was frozen: give it its old name back",
)
_SCENE_CHANGED_SINCE_FROZEN = Pattern(
    "plans.documents.scene_changed_since_frozen",
    "scene {name} was changed since {plan} was frozen ({differs}): change it back, or amend the plan",
)

_CHECKPOINT_SWITCHED_OFF_OWNER_CAN = Pattern(
    "plans.allocation.checkpoint_switched_off_owner_can",
    "a checkpoint of {plan} is switched off: its owner can say why",
)
_CHECKPOINT_CHANGED_SINCE_FROZEN_CHANGE = Pattern(
    "plans.allocation.checkpoint_changed_since_frozen_change",
    "a checkpoint was changed since {plan} was frozen: change it back, or amend the plan",
)
_CHECKPOINT_RENAMED_SINCE_FROZEN = Pattern(
    "plans.allocation.checkpoint_renamed_since_frozen",
    "a checkpoint of {plan} was renamed since it was frozen: give it its old name back",
)
# Format 2 had no outcome, margin, looks or boundary; 3 at most one "comparison", of paired blocks; 4 was scored by the
# scenes as they were at the time; reveals of 5 stored neither caveats nor the digest of the record, those of 6 nothing
# for a plan without a comparison.
FORMAT = 7
_LEFT_OUT = ("bench", "bench_digest")  # keys of a scene that the default bench does not have
_DRAWN_BY_ITSELF = 6  # format from which the order within each block is drawn independently


def document_of(plan: Plan, key: bytes) -> dict[str, Any]:
    """Return the frozen form of a draft as plain JSON; the schedule is drawn from the secret `key`.

    Raises: UnevenError if the drawn random order does not fit the design; EvaError if the design is invalid.
    """
    positions: dict[Scene, list[Position]] = defaultdict(list)
    for position in plan.positions.select_related("scene").order_by("scene__name", "number"):
        positions[position.scene].append(position)
    document = {
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
        "allocation": plan.allocation,
        "comparisons": [list(pair) for pair in planned(plan)],
        "second_rater_share": plan.second_rater_share,
        "match_gate": plan.match_gate,
        "counts_as": {name: getattr(plan, name) for name in ENDS},
    }
    return {**document, "stopping": _design(plan, document, key)}


def _design(plan: Plan, document: dict[str, Any], key: bytes) -> dict[str, Any]:
    counts = None
    if plan.allocation == Allocation.RANDOM:
        names = next(iter(document["comparisons"]), [row["name"] for row in document["checkpoints"]])
        counts = counts_of(_units(document, key), names)
        _check_counts(counts[-1], bounded=plan.stopping in SHAPES or plan.margin is not None)
    drafted = draft_design(plan, counts)
    return {
        "rule": plan.stopping,
        "alpha": plan.alpha,
        "drops": plan.drop_arms,
        "outcome": plan.outcome,
        "margin": plan.margin,
        "pairs": drafted.blocks if drafted else None,
        "counts": [list(count) for count in counts] if counts is not None else None,
        "boundary": boundary_table(drafted.boundary) if drafted and drafted.boundary else None,
    }


class UnevenError(EvaError):
    """Error for a random order whose numbers of trials do not fit the design; another key draws another order."""


def _check_counts(counts: tuple[int, int], *, bounded: bool) -> None:
    if min(counts) == 0 or (bounded and max(counts) > MOST):
        raise UnevenError(
            _RANDOM_ORDER_TWO_CHECKPOINTS_CAME(
                made=counts[0],
                made_2=counts[1],
                most=MOST if bounded else "any number",
                which="fewer" if bounded and min(counts) else "more",
            )
        )


def scene_of(scene: Scene, positions: list[Position]) -> dict[str, Any]:
    """Return a scene with the given positions and all its milestones as plain JSON."""
    return {
        "name": scene.name,
        "title": scene.title,
        "instruction": scene.instruction,
        "criterion": scene.criterion,
        "layout": scene.layout,
        # The default is left out: digests of plans frozen before there were several benches stay the same.
        **(
            {"bench": scene.bench, "bench_digest": scene.bench_digest} if scene.bench != DEFAULT_BENCH else {}
        ),
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


def require_checkpoints(plan: Plan) -> None:
    """Raise Conflict if any of the plan's checkpoints differs from its frozen form or is deactivated.

    All checkpoints are checked, whichever the trial uses, and the message names none of them: otherwise deactivating a
    checkpoint would reveal whether it comes next.
    """
    by_name = {row.name: row for row in plan.checkpoints.all()}
    for row in (plan.document or {})["checkpoints"]:
        now = by_name.get(row["name"])
        if now is None:
            raise Conflict(_CHECKPOINT_RENAMED_SINCE_FROZEN(plan=plan))
        if not now.active:
            raise Conflict(_CHECKPOINT_SWITCHED_OFF_OWNER_CAN(plan=plan))
        if digest(checkpoint_of(now)) != digest(row):
            raise Conflict(_CHECKPOINT_CHANGED_SINCE_FROZEN_CHANGE(plan=plan))


def require_scene(plan: Plan, scene: Scene) -> None:
    """Raise Conflict, with the differences, if the scene differs from its frozen form.

    Success could then mean something else.
    """
    frozen = next((row for row in (plan.document or {})["scenes"] if row["name"] == scene.name), None)
    if frozen is None:
        raise Conflict(_SCENE_RENAMED_SINCE_FROZEN(plan=plan))
    numbers = [position["number"] for position in frozen["positions"]]
    now = scene_of(scene, list(scene.positions.filter(number__in=numbers).order_by("number")))
    differs = list(_differences(frozen, now))
    if differs:
        raise Conflict(_SCENE_CHANGED_SINCE_FROZEN(name=scene.name, plan=plan, differs="; ".join(differs)))


def _differences(frozen: dict[str, Any], now: dict[str, Any]) -> Iterator[str]:
    """Yield each changed value as text; a key that only one of the two has is a change."""
    for key in (*frozen, *(key for key in _LEFT_OUT if key in now and key not in frozen)):
        value = frozen.get(key)
        if not isinstance(value, list):
            if value != now.get(key):
                yield f"{key} was {value!r}, is {now.get(key)!r}"
            continue
        named, kind = ("order", "milestone") if key == "milestones" else ("number", "position")
        before, after = ({row[named]: row for row in rows} for rows in (value, now[key]))
        for number in sorted({*before, *after}):
            if number not in after or number not in before:
                yield f"{kind} {number} {'is gone' if number in before else 'is new'}"
                continue
            changed = [name for name, was in before[number].items() if was != after[number].get(name)]
            yield from (
                f"{kind} {number}: {name} was {before[number][name]!r}, is {after[number].get(name)!r}"
                for name in changed
            )


def checkpoint_of(checkpoint: Checkpoint) -> dict[str, Any]:
    """Return a checkpoint as plain JSON: name, description, policy, and the optional fields that are set."""
    named = {name: getattr(checkpoint, name) for name in ("digest", "recipe", "strategy", "anchor")}
    return {
        "name": checkpoint.name,
        "description": checkpoint.description,
        "policy": checkpoint.policy,
        **{name: value for name, value in named.items() if value},
    }


def conditions_of(document: dict[str, Any]) -> list[Condition]:
    """Return the initial conditions of a frozen plan."""
    return [
        Condition(scene["name"], position["number"])
        for scene in document["scenes"]
        for position in scene["positions"]
    ]


def units_of(plan: Plan) -> list[Unit]:
    """Return the schedule of a frozen plan, drawn from its key."""
    return _units(plan.document or {}, bytes(plan.key or b""))


def _units(document: dict[str, Any], key: bytes) -> list[Unit]:
    return schedule(
        checkpoints=[row["name"] for row in document["checkpoints"]],
        conditions=conditions_of(document),
        repetitions=document["repetitions"],
        key=key,
        allocation=document.get("allocation", PAIRED),
        latin=document.get("format", 1) < _DRAWN_BY_ITSELF,
    )
