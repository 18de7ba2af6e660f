"""A plan's draft as plain values by field, and the merging of concurrent edits.

Two users may edit one draft at a time. Each form sends the values it was loaded with and the typed ones: a field that
both changed is a conflict and is not written. Checkpoints hidden from a user are not among the values, and stay
unchanged.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from evaweb.blinding.visibility import FULL_VISIBILITY, Visibility
from evaweb.core.canonical_json import digest
from evaweb.plans.models import Comparing, Plan
from evaweb.trials.models import Checkpoint

HIDDEN = "hidden"  # placeholder for a checkpoint hidden from the user
_PLAIN = (
    *("title", "question", "comparing", "stopping", "repetitions", "alpha", "look_after", "drop_arms"),
    *("allocation", "outcome", "margin", "blind", "second_rater_share", "match_gate"),
    *("on_estop", "on_interruption", "on_timeout"),
)
_SETS = ("positions", "stations")
Values = dict[str, Any]
Roles = tuple[int | None, int | None]


@dataclass(frozen=True, slots=True)
class Changed:
    """Draft after an edit: its values now, and the fields not written because another user had changed them."""

    now: Values
    conflicts: tuple[str, ...]


def values_of(plan: Plan, sight: Visibility = FULL_VISIBILITY) -> Values:
    """Return the values of the draft that its pages edit, by field, without hidden checkpoints.

    Checkpoints are given by their ids, as text; HIDDEN replaces the id of a hidden one. The value "control" is the
    checkpoint with which others are compared, the value "challenger" the checkpoint that is compared with the control.
    If the plan has only these two checkpoints, "challenger" is "", because it follows from the control.
    """
    chosen = set(plan.checkpoints.values_list("pk", flat=True))
    control, challenger = _roles(plan)
    if len(chosen) == 2 and {control, challenger} == chosen:
        challenger = None
    hidden = sight.checkpoints
    return {
        **{name: getattr(plan, name) for name in _PLAIN if name != "question" or not sight.hides_plan(plan)},
        **{name: sorted(getattr(plan, name).values_list("pk", flat=True)) for name in _SETS},
        "owner": plan.owner_id,
        "checkpoints": sorted(chosen - set(hidden)),
        "control": _told(control, hidden),
        "challenger": _told(challenger, hidden),
    }


def digest_of(values: Values) -> str:
    """Return the digest that identifies the draft as a user sees it."""
    return digest(values)


def merged(
    now: Values, was: Mapping[str, Any], wanted: Values, keep: Collection[str]
) -> tuple[Values, list[str]]:
    """Return the fields of a draft to write, and the names of the conflicting fields.

    Args:
        now: Values in the database.
        was: Values that the user's form was loaded with.
        wanted: Values that the user wants.
        keep: Names of fields that are written in spite of a conflict.
    """
    written, conflicts = {}, []
    for name, value in wanted.items():
        if name not in now or value == now[name]:
            continue
        if name in keep or (name in was and was[name] == now[name]):
            written[name] = value
        elif value != was.get(name):
            conflicts.append(name)
    return written, conflicts


def apply(plan: Plan, values: Values, hidden: Collection[int] = ()) -> None:
    """Set the draft's fields to `values`.

    The positions, stations and checkpoints are saved here. The caller must save the other fields. The draft keeps those
    of its checkpoints whose ids are in `hidden`, because `values` cannot contain them.
    """
    roles = _roles(plan)  # read before the change: their meaning depends on `comparing`
    for name in values.keys() & set(_PLAIN):
        setattr(plan, name, values[name])
    plan.owner_id = values["owner"]
    for name in _SETS:
        getattr(plan, name).set(values[name])
    before = set(plan.checkpoints.values_list("pk", flat=True))
    retained = before & set(hidden)
    plan.checkpoints.set({*values["checkpoints"], *retained})
    _compare(plan, values, {*values["checkpoints"], *retained}, roles)


def _compare(plan: Plan, values: Values, chosen: set[int], roles: Roles) -> None:
    """Set the comparison's first and second checkpoint from the control and the challenger in `values`.

    `roles` are control and challenger before the change. A role for which `values` has HIDDEN keeps its checkpoint,
    because the user may not know which one it is.
    """
    control, challenger = roles
    control = control if values["control"] == HIDDEN else _number(values["control"])
    challenger = challenger if values["challenger"] == HIDDEN else _number(values["challenger"])
    control = control if control in chosen else None
    challenger = challenger if challenger in chosen - {control} else None
    if challenger is None and control is not None and len(chosen) == 2:
        challenger = (chosen - {control}).pop()
    if plan.comparing == Comparing.ALL:
        first, second = None, None
    elif plan.comparing == Comparing.CONTROL:
        first, second = control, None
    elif control is None or challenger is None:
        first, second = None, control  # keeps the control; the checks refuse the plan until both are chosen
    else:
        first, second = challenger, control
    rows = Checkpoint.objects.in_bulk([pk for pk in (first, second) if pk])
    plan.first = rows[first] if first else None
    plan.second = rows[second] if second else None


def _roles(plan: Plan) -> Roles:
    """Return the ids of the draft's control and challenger; an id is None if that checkpoint is not chosen."""
    if plan.comparing == Comparing.CONTROL:
        return plan.first_id, None
    return plan.second_id, plan.first_id


def _told(pk: int | None, hidden: Collection[int]) -> str:
    return "" if pk is None else HIDDEN if pk in hidden else str(pk)


def _number(value: str) -> int | None:
    return int(value) if value else None
