"""Writing of a whole scene with its positions and milestones, as the scene editor sends it.

Rows used by trials or frozen plans are not changed; concurrent edits are detected instead of overwritten.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any

from django.contrib.admin.models import ADDITION, CHANGE, LogEntry
from django.contrib.auth.models import User
from django.core.exceptions import ValidationError as Invalid
from django.db import models, transaction
from pydantic import ValidationError

from evaweb.accounts.roles import Role, require_role
from evaweb.core.canonical_json import difference
from evaweb.core.errors import Conflict, EvaError
from evaweb.core.write_conflicts import once_more
from evaweb.trials.models import Milestone, Position, Scene
from evaweb.trials.scene_reading import (
    FIELDS,
    MILESTONE,
    POSITION,
    MilestoneTable,
    PositionTable,
    SceneTable,
    protected_positions,
    running_plans,
    scene_digest,
    scene_table,
    values_of,
)
from evaweb.trials.tables import check_milestones, simulated_bench
from runtime.core.sentences import Pattern

_SCENE_DOES_NOT_EXIST_ANY = Pattern(
    "trials.scene_writing.scene_does_not_exist_any",
    "scene {name!r:.80} does not exist any more: nothing was saved",
)

_IDS = {
    "positions": {"__all__": {"id"}},
    "milestones": {"__all__": {"id"}},
}  # row ids, which only the database assigns


@dataclass(frozen=True, slots=True)
class Fault:
    """Problem at one place, such as "positions.2.bench"; the text names the item, the given and the allowed values."""

    place: str
    text: str


class SceneRefused(EvaError):
    """Error for an invalid scene; `faults` lists all invalid places."""

    def __init__(self, faults: Sequence[Fault]) -> None:
        super().__init__("; ".join(fault.text for fault in faults))
        self.faults = tuple(faults)


class ChangedMeanwhile(Conflict):
    """Error for a scene that has changed since the editor loaded it.

    `seen` is the digest of the current version, with which it can be overwritten.
    """

    def __init__(self, scene: Scene, seen: str) -> None:
        last = LogEntry.objects.filter(object_id=str(scene.pk), content_type__model="scene").first()
        by = f" by {last.user.get_username()}, {last.action_time:%Y-%m-%d %H:%M} UTC" if last else ""
        super().__init__(f"scene {scene.name} was changed meanwhile{by}; nothing of yours was saved or lost")
        self.seen = seen


@once_more
@transaction.atomic
def scene_write(
    *, user: User, name: str | None, given: Mapping[str, Any], seen: str = ""
) -> tuple[Scene, list[str]]:
    """Write the scene called `name` (None: a new one); return it and remarks on the consequences of the change.

    `seen` is the result of `scene_digest` when the editor read the scene. If the content is already identical, the
    request is a repetition whose answer was lost, and nothing is written.

    Raises:
        NotAllowed: The user is not an administrator.
        SceneRefused: Names every invalid place; nothing is written.
        ChangedMeanwhile: Another user has changed the scene; nothing is written.
    """
    require_role(user, Role.ADMIN)
    table = table_of(given)
    scene = Scene.objects.select_for_update().filter(name=name).first() if name is not None else Scene()
    if scene is None:
        raise Conflict(_SCENE_DOES_NOT_EXIST_ANY(name=name))
    existing = scene if name is not None else Scene.objects.filter(name=table.name).first()
    if existing is not None and _equals(existing, table):
        return existing, []
    if name is None:
        scene.name = table.name
    elif scene_digest(scene) != seen:
        raise ChangedMeanwhile(scene, scene_digest(scene))
    before = scene_table(scene) if scene.pk else None
    faults = _assigned(scene, table)
    if faults:
        raise SceneRefused(faults)
    scene.save()
    other_bench = before is not None and before["bench"] != scene.bench
    faults = _write_positions(scene, table.positions, check_all=other_bench)
    faults += _write_milestones(scene, table.milestones)
    if faults:
        raise SceneRefused(faults)
    after = scene_table(scene)
    if after != before:
        flag, text = (CHANGE, _changed(before, after)) if before else (ADDITION, "made in the scene editor")
        LogEntry.objects.log_actions(user.pk, [scene], flag, text, single_object=True)
    return scene, _remarks(scene, before, after)


def _equals(scene: Scene, table: SceneTable) -> bool:
    """Return True if the scene already equals `table`, in which new rows have no id."""
    stored = SceneTable.model_validate(scene_table(scene))
    pairs = (
        zip(stored.positions, table.positions, strict=False),
        zip(stored.milestones, table.milestones, strict=False),
    )
    same = all(requested.id in (None, row.id) for pair in pairs for row, requested in pair)
    return same and stored.model_dump(exclude=_IDS) == table.model_dump(exclude=_IDS)


def table_of(given: object) -> SceneTable:
    """Return the validated scene. Raises: SceneRefused with every invalid place."""
    try:
        return SceneTable.model_validate(given)
    except ValidationError as error:
        faults = [
            Fault(
                place := ".".join(map(str, fault["loc"])) or "scene",
                f"{place} = {fault['input']!r:.60}: {fault['msg']}",
            )
            for fault in error.errors()
        ]
        raise SceneRefused(faults) from None


def _assigned(scene: Scene, table: SceneTable) -> list[Fault]:
    for name in FIELDS:
        setattr(scene, name, getattr(table, name))
    faults = _faults(scene, "", "")
    if not table.positions:
        faults.append(Fault("positions", "positions: none; allowed: at least one, from which a trial begins"))
    return faults


def _write_positions(scene: Scene, tables: Sequence[PositionTable], *, check_all: bool) -> list[Fault]:
    rows = {row.pk: row for row in scene.positions.all()}
    protected = protected_positions(scene)
    faults = [*_strangers(tables, rows, "positions"), *_twice(tables)]
    faults += [
        Fault("positions", f"position {row.number} is not removed, because of {reason}")
        for row in rows.values()
        if row.pk not in {table.id for table in tables}
        and (reason := protected.get(row.pk) or _pictured(row))
    ]
    if faults:
        return faults
    scene.positions.exclude(pk__in=[table.id for table in tables if table.id]).delete()
    for index, table in enumerate(tables):
        row = rows[table.id] if table.id else Position(scene=scene)
        values = table.model_dump(include=set(POSITION))
        if check_all or not table.id or _plain(values_of(row, POSITION)) != _plain(values):
            faults += _position_written(row, values, f"positions.{index}", protected.get(row.pk, ""))
    return faults


def _position_written(row: Position, values: Mapping[str, Any], place: str, protection: str) -> list[Fault]:
    label = f"position {values['number']}"
    if protection:
        text = f"position {row.number} is not changed, because of {protection}: add another position instead"
        return [Fault(place, text)]
    if row.pk and row.number != values["number"]:
        return [Fault(place, f"position {row.number}: its number stays, for seeds and exports have it")]
    for name, value in values.items():
        setattr(row, name, value)
    faults = _faults(row, f"{place}.", label)
    if not faults and (problem := _bench_problem(row)):
        faults = [Fault(f"{place}.bench", f"{label}: {problem}")]
    if not faults:
        row.save()
    return faults


def _bench_problem(row: Position) -> str:
    """Return why the scene's simulated bench would refuse this layout, "" if it would accept."""
    return next(row.scene.schema.problems(simulated_bench(row.bench) or {}), "")


def _write_milestones(scene: Scene, tables: Sequence[MilestoneTable]) -> list[Fault]:
    rows = {row.pk: row for row in scene.milestones.all()}
    faults = _strangers(tables, rows, "milestones")
    texts = [table.text for table in tables if table.text]
    if any(not table.id or (table.id in rows and rows[table.id].text != table.text) for table in tables):
        try:
            check_milestones(texts)
        except Invalid as invalid:
            faults.append(Fault("milestones", f"milestones: {'; '.join(invalid.messages)}"))
    if faults:
        return faults
    scene.milestones.exclude(pk__in=[table.id for table in tables if table.id]).delete()
    _make_room(scene, len(tables))
    for index, table in enumerate(tables):
        row = rows[table.id] if table.id else Milestone(scene=scene)
        row.order = index + 1
        for name in MILESTONE:
            setattr(row, name, getattr(table, name))
        problems = _faults(row, f"milestones.{index}.", f"milestone {index + 1}")
        faults += problems
        if not problems:
            row.save()
    return faults


def _make_room(scene: Scene, n: int) -> None:
    """Move all milestones of the scene to places above the first `n`, so that these are free.

    The places stay unique while the milestones are then moved to their new ones one by one.
    """
    used = set(scene.milestones.values_list("order", flat=True))
    free = (place for place in count(n + 1) if place not in used)
    for row in scene.milestones.all():
        scene.milestones.filter(pk=row.pk).update(order=next(free))


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """Normalize texts as forms do: one kind of line end, no surrounding blanks."""
    texts = {
        name: value.replace("\r\n", "\n").strip() for name, value in values.items() if isinstance(value, str)
    }
    return {**values, **texts}


def _strangers(tables: Sequence[Any], rows: Mapping[int, Any], kind: str) -> list[Fault]:
    """Return a fault for each id in `tables` that is not a key of `rows` (the scene's own), or that occurs twice."""
    ids = [table.id for table in tables if table.id is not None]
    wrong = [id for id in ids if id not in rows or ids.count(id) > 1]
    return [
        Fault(kind, f"{kind}: id {id} is not one of this scene, or there twice")
        for id in dict.fromkeys(wrong)
    ]


def _twice(tables: Sequence[PositionTable]) -> list[Fault]:
    numbers = [table.number for table in tables]
    repeated = sorted({number for number in numbers if numbers.count(number) > 1})
    return [
        Fault("positions", f"two positions have the number {number}; allowed: each once")
        for number in repeated
    ]


def _pictured(row: Position) -> str:
    """Return the reason to keep a position that has reference pictures; "" if the position has none."""
    return "reference pictures" if row.references.exists() else ""  # type: ignore[attr-defined]


def _faults(row: models.Model, place: str, label: str) -> list[Fault]:
    try:
        row.full_clean()
    except Invalid as invalid:
        return [
            Fault(f"{place}{field}", ": ".join(filter(None, (label, _name(row, field), " ".join(messages)))))
            for field, messages in invalid.message_dict.items()
        ]
    return []


def _name(row: models.Model, field: str) -> str:
    names = {column.name: str(column.verbose_name) for column in row._meta.fields}
    return names.get(field, "scene")


def _changed(before: Mapping[str, Any] | None, after: Mapping[str, Any]) -> str:
    return f"changed in the scene editor: {'; '.join(difference(before or {}, after))}"


def _remarks(scene: Scene, before: Mapping[str, Any] | None, after: Mapping[str, Any]) -> list[str]:
    """Return remarks on the consequences of the change for existing trials, plans and reference pictures."""
    if before is None or before == after:
        return []
    remarks = []
    trials = scene.trials.count()
    if trials and any(before[name] != after[name] for name in ("positions", "milestones")):
        remarks.append(
            f"{trials} trial{'s' if trials > 1 else ''} made before keep the old positions and milestones in their "
            "scores: where trials are to be compared, make another scene instead."
        )
    plans = running_plans(scene)
    frozen = set(after) - {"active", "failure_required", "positions"}
    if plans and any(before[name] != after[name] for name in frozen):
        remarks.append(f"This stops {', '.join(plans)} until it is changed back, or the plan is amended.")
    moved = {row["id"]: row for row in before["positions"]}
    stale = [
        row for row in after["positions"] if row["id"] in moved and moved[row["id"]]["bench"] != row["bench"]
    ]
    pictured = scene.positions.filter(pk__in=[row["id"] for row in stale], references__isnull=False)
    return remarks + [
        f"Position {row.number} has reference pictures of how it was: take them anew."
        for row in pictured.distinct()
    ]
