"""Import and export of scenes, checkpoints and plans as TOML, for exchange between labs.

    [[scene]]       name, title, instruction, criterion, layout, bench, time_limit_s, ordered, failure_required
    [[scene.position]]   number, label, description, bench
    [[scene.milestone]]  order, text, points, required, time_limit_s, truth
    [[checkpoint]]  name, description, policy, digest, parent (a name), recipe, tags, strategy, anchor
    [[plan]]        name, title, question, positions (scene and number each), checkpoints, repetitions, ...
    [[reference]]   picture of a camera at a position; see `references`

An existing object of the same name is left unchanged if equal, changed if no trial uses it, and otherwise the file is
refused with the differences. A file is imported as a whole, or not at all.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import tomli_w
from django.contrib.auth.models import User
from django.core.exceptions import ValidationError as Invalid
from django.db import models, transaction
from pydantic import ValidationError

from evaweb.accounts.roles import Role, require_role
from evaweb.core.canonical_json import difference
from evaweb.core.errors import Conflict, EvaError
from evaweb.plans.frozen_document import checkpoint_of, scene_of
from evaweb.plans.models import Comparing, Plan, PlanState, Reference
from evaweb.plans.references import import_references, packed, reference_tables
from evaweb.plans.toml_schema import (
    CheckpointTable,
    File,
    PlaceTable,
    PlanTable,
    SceneTable,
)
from evaweb.stations.models import Station
from evaweb.trials.models import Checkpoint, Milestone, Position, Scene
from evaweb.trials.scene_reading import protected_positions
from evaweb.trials.selectors import checkpoint_used
from evaweb.trials.tables import check_milestones
from runtime.core import bounded_documents as bounded
from runtime.core.sentences import Pattern

_CHECKPOINT_PARENT_DOES_NOT_EXIST = Pattern(
    "plans.exchange.checkpoint_parent_does_not_exist",
    "checkpoint {name}: parent = {parent!r} does not exist, here or further up in the file",
)
_PLAN_AMEND_THEN_CHANGE_DRAFT = Pattern(
    "plans.exchange.plan_amend_then_change_draft",
    "plan {name} is {state}: amend it, then change the draft",
)
_PLAN_COMPARISON_WITH_COMPARING_ALLOWED = Pattern(
    "plans.exchange.plan_comparison_with_comparing_allowed",
    "plan {name}: comparison = {comparison} with comparing = {comparing!r}; allowed: {words} checkpoints",
)
_PLAN_POSITION_SCENE_DOES_NOT = Pattern(
    "plans.exchange.plan_position_scene_does_not",
    "plan {name}: position {number} of scene {scene!r} does not exist",
)
_PLAN_DOES_NOT_EXIST = Pattern(
    "plans.exchange.plan_does_not_exist",
    "plan {name}: {kind} {name_2!r} does not exist",
)
_HAS_TRIALS_ANOTHER_ONE_FILE = Pattern(
    "plans.exchange.has_trials_another_one_file",
    "{what} is in use (trials or a frozen plan) and is another one in the file ({shown}): give it another name",
)

_Row = TypeVar("_Row", bound=models.Model)


# --- out ---------------------------------------------------------------------------------------------------


def export_toml(
    *,
    scenes: list[Scene] | None = None,
    checkpoints: list[Checkpoint] | None = None,
    plans: list[Plan] | None = None,
) -> str:
    """Return a TOML file with these objects, and the scenes and checkpoints that the plans use."""
    return _written(scenes, checkpoints, plans)[0]


def export_archive(
    *,
    scenes: list[Scene] | None = None,
    checkpoints: list[Checkpoint] | None = None,
    plans: list[Plan] | None = None,
) -> bytes:
    """Return an archive of `export_toml` with the reference pictures of the positions."""
    text, references = _written(scenes, checkpoints, plans)
    return packed(text, "lab.toml", references)


def _written(
    scenes: list[Scene] | None, checkpoints: list[Checkpoint] | None, plans: list[Plan] | None
) -> tuple[str, list[dict[str, Any]]]:
    shown_scenes = {scene.pk: scene for scene in scenes or ()}
    shown_checkpoints = {row.pk: row for row in checkpoints or ()}
    for plan in plans or ():
        shown_scenes |= {p.scene.pk: p.scene for p in plan.positions.select_related("scene")}
        shown_checkpoints |= {row.pk: row for row in plan.checkpoints.all()}
    shown_checkpoints |= {
        above.pk: above for row in list(shown_checkpoints.values()) for above in row.lineage
    }
    references = reference_tables(shown_scenes.values())
    written = {
        "scene": [_scene_table(row) for row in sorted(shown_scenes.values(), key=lambda row: row.name)],
        "checkpoint": [_checkpoint_table(row) for row in sorted(shown_checkpoints.values(), key=_generation)],
        "plan": [_plan_table(plan) for plan in plans or ()],
        "reference": references,
    }
    return tomli_w.dumps({key: _without_none(rows) for key, rows in written.items() if rows}), references


def _scene_table(scene: Scene) -> dict[str, Any]:
    table = scene_of(scene, list(scene.positions.order_by("number")))
    table["bench"] = scene.bench
    table.pop("bench_digest", None)
    table["failure_required"] = scene.failure_required  # a rule for raters, not part of a frozen plan
    table["position"], table["milestone"] = table.pop("positions"), table.pop("milestones")
    return table


def _checkpoint_table(checkpoint: Checkpoint) -> dict[str, Any]:
    parent = checkpoint.parent.name if checkpoint.parent else None
    return {
        **checkpoint_of(checkpoint),
        "digest": checkpoint.digest,
        "parent": parent,
        "recipe": checkpoint.recipe,
        "tags": checkpoint.tags,
        "strategy": checkpoint.strategy,
        "anchor": checkpoint.anchor,
    }


def _generation(checkpoint: Checkpoint) -> tuple[int, str]:
    """Return a sort key that places every checkpoint after its parent."""
    return len(checkpoint.lineage), checkpoint.name


def _plan_table(plan: Plan) -> dict[str, Any]:
    return {
        "name": plan.name,
        "title": plan.title,
        "question": plan.question,
        "positions": [
            {"scene": p.scene.name, "number": p.number}
            for p in plan.positions.select_related("scene").order_by("scene__name", "number")
        ],
        "checkpoints": list(plan.checkpoints.order_by("name").values_list("name", flat=True)),
        "repetitions": plan.repetitions,
        "stations": list(plan.stations.order_by("name").values_list("name", flat=True)),
        "strategy": plan.strategy,
        "blind": plan.blind,
        "allocation": plan.allocation,
        "stopping": plan.stopping,
        "comparing": plan.comparing,
        "drop_arms": plan.drop_arms,
        "outcome": plan.outcome,
        "margin": plan.margin,
        "look_after": plan.look_after,
        "alpha": plan.alpha,
        "comparison": [row.name for row in (plan.first, plan.second) if row],
        "second_rater_share": plan.second_rater_share,
        "match_gate": plan.match_gate,
        **{name: getattr(plan, name) for name in ("on_estop", "on_interruption", "on_timeout")},
    }


def _without_none(value: Any) -> Any:
    """Remove None values, because TOML has no null."""
    if isinstance(value, Mapping):
        return {key: _without_none(inner) for key, inner in value.items() if inner is not None}
    if isinstance(value, list):
        return [_without_none(inner) for inner in value]
    return value


# --- in ----------------------------------------------------------------------------------------------------


def import_file(*, user: User, text: str, pictures: Mapping[str, bytes] | None = None) -> list[str]:
    """Import a file and return a message per object. Raises: EvaError or Conflict; nothing is imported then.

    `pictures` are the contents of the picture files of an archive, by the names that references use.
    """
    require_role(user, Role.ADMIN)
    tables = _read(text)
    with transaction.atomic():
        return [
            *(_take_scene(table) for table in tables.scene),
            *(_take_checkpoint(table) for table in tables.checkpoint),
            *(_take_plan(table, user) for table in tables.plan),
            *import_references([row.model_dump() for row in tables.reference], pictures or {}, user),
        ]


def _read(text: str) -> File:
    try:
        return File.model_validate(bounded.parse_toml(text, "the file"))
    except bounded.UnreadableDocument as error:
        raise EvaError(str(error)) from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise EvaError(f"{where}: {first['msg']} (given: {first['input']!r:.80})") from None


def _take_scene(table: SceneTable) -> str:
    existing = Scene.objects.select_for_update().filter(name=table.name).first()
    values = table.model_dump()
    positions, milestones = values.pop("position"), values.pop("milestone")
    if existing is not None:
        now = _scene_table(existing)
        changes = difference(now, {**values, "position": positions, "milestone": milestones})
        if not changes:
            return f"scene {existing.name}: the same"
        if protected_positions(existing) or Reference.objects.filter(position__scene=existing).exists():
            raise _refused(f"scene {existing.name}", changes)
        existing.positions.all().delete()
        existing.milestones.all().delete()
    try:
        check_milestones([row["text"] for row in milestones])
    except Invalid as invalid:
        raise EvaError(f"scene {table.name}: {'; '.join(invalid.messages)}") from None
    scene = existing or Scene(name=table.name)
    for name, value in values.items():
        setattr(scene, name, value)
    _unchanged_note(scene, f"scene {table.name}")
    for row in positions:
        _unchanged_note(Position(scene=scene, **row), f"position {row['number']} of scene {table.name}")
    for row in milestones:
        _unchanged_note(Milestone(scene=scene, **row), f"milestone {row['order']} of scene {table.name}")
    return f"scene {scene.name}: {'changed' if existing else 'new'}"


def _take_checkpoint(table: CheckpointTable) -> str:
    existing = Checkpoint.objects.select_for_update().filter(name=table.name).first()
    values = table.model_dump()
    if existing is not None:
        changes = difference(_checkpoint_table(existing), values)
        if not changes:
            return f"checkpoint {existing.name}: the same"
        if checkpoint_used(existing):
            raise _refused(f"checkpoint {existing.name}", changes)
    checkpoint = existing or Checkpoint()
    parent = values.pop("parent")
    checkpoint.parent = Checkpoint.objects.filter(name=parent).first() if parent else None
    if parent and checkpoint.parent is None:
        raise EvaError(_CHECKPOINT_PARENT_DOES_NOT_EXIST(name=table.name, parent=parent))
    for name, value in values.items():
        setattr(checkpoint, name, value)
    _unchanged_note(checkpoint, f"checkpoint {table.name}")
    return f"checkpoint {checkpoint.name}: {'changed' if existing else 'new'}"


def _take_plan(table: PlanTable, user: User) -> str:
    newest = Plan.objects.select_for_update().filter(name=table.name).order_by("-version").first()
    if newest is not None and newest.state != PlanState.DRAFT:
        raise Conflict(_PLAN_AMEND_THEN_CHANGE_DRAFT(name=table.name, state=newest.get_state_display()))
    plan = newest or Plan(name=table.name, owner=user)
    values = table.model_dump(exclude={"positions", "checkpoints", "stations", "comparison"})
    for name, value in values.items():
        setattr(plan, name, value)
    checkpoints = [_named(Checkpoint, "checkpoint", name, table) for name in table.checkpoints]
    stations = [_named(Station, "station", name, table) for name in table.stations]
    compared = [_named(Checkpoint, "checkpoint", name, table) for name in table.comparison]
    allowed = {Comparing.CONTROL: (1,), Comparing.ALL: (0,)}.get(Comparing(table.comparing), (0, 2))
    if len(compared) not in allowed:
        numbers = " or ".join(map(str, allowed))
        raise EvaError(
            _PLAN_COMPARISON_WITH_COMPARING_ALLOWED(
                name=table.name, comparison=table.comparison, comparing=table.comparing, words=numbers
            )
        )
    plan.first, plan.second = (*compared, None, None)[:2]
    _unchanged_note(plan, f"plan {table.name}")
    plan.positions.set([_position(place, table) for place in table.positions])
    plan.checkpoints.set(checkpoints)
    plan.stations.set(stations)
    return f"plan {plan.name}: {'draft changed' if newest else 'new draft'}"


def _position(place: PlaceTable, table: PlanTable) -> Position:
    position = Position.objects.filter(scene__name=place.scene, number=place.number).first()
    if position is None:
        raise EvaError(_PLAN_POSITION_SCENE_DOES_NOT(name=table.name, number=place.number, scene=place.scene))
    return position


def _named(model: type[_Row], kind: str, name: str, table: PlanTable) -> _Row:
    row = model._default_manager.filter(name=name).first()
    if row is None:
        raise EvaError(_PLAN_DOES_NOT_EXIST(name=table.name, kind=kind, name_2=name))
    return row


def _unchanged_note(row: models.Model, label: str) -> None:
    try:
        row.full_clean()
    except Invalid as invalid:
        problem = next(iter(invalid.message_dict.items()))
        raise EvaError(f"{label}: {problem[0]}: {'; '.join(problem[1])}") from None
    row.save()


def _refused(label: str, changes: list[str]) -> Conflict:
    listed = "; ".join(changes[:5]) + (f"; and {len(changes) - 5} more" if len(changes) > 5 else "")
    return Conflict(_HAS_TRIALS_ANOTHER_ONE_FILE(what=label, shown=listed))
