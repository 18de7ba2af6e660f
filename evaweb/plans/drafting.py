"""A draft as plain values, by field: what a person has before them, what they changed of it, what a change makes of it.

Two people may have the same draft open. Each sends what they were shown with what they typed: a field that both changed
is a conflict that names both values, and is not written. Checkpoints that are hidden from a person are not among the
values, and stay what they are.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from evaweb.blinding import FULL_VISIBILITY, Visibility
from evaweb.canonical import digest
from evaweb.plans.models import Comparing, Plan
from evaweb.trials.models import Checkpoint

HIDDEN = "hidden"  # stands for a checkpoint that the person is not told
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
    """A draft after a change: its values, and the fields that were not written because somebody else changed them."""

    now: Values
    conflicts: tuple[str, ...]


def values_of(plan: Plan, sight: Visibility = FULL_VISIBILITY) -> Values:
    """Everything of the draft that the plan's pages edit, as far as it is not hidden.

    `control` is the checkpoint with which others are compared, `challenger` the one that is compared with it where that
    is one of several: with two checkpoints it is the other one.
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
    """Name of the draft as a person has it before them."""
    return digest(values)


def merged(
    now: Values, was: Mapping[str, Any], wanted: Values, keep: Collection[str]
) -> tuple[Values, list[str]]:
    """The fields to be written, and those that somebody else changed too; `keep`: written all the same."""
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
    """Make the draft what `values` say; it is not saved, but for the lists of positions, stations and checkpoints."""
    roles = _roles(plan)  # under the meaning that they had: `comparing` may be among what changes
    for name in values.keys() & set(_PLAIN):
        setattr(plan, name, values[name])
    plan.owner_id = values["owner"]
    for name in _SETS:
        getattr(plan, name).set(values[name])
    before = set(plan.checkpoints.values_list("pk", flat=True))
    kept = before & set(hidden)
    plan.checkpoints.set({*values["checkpoints"], *kept})
    _compare(plan, values, {*values["checkpoints"], *kept}, roles)


def _compare(plan: Plan, values: Values, chosen: set[int], roles: Roles) -> None:
    """The comparison's first and second of control and challenger; `roles` are those before the change."""
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
        first, second = None, control  # said, and refused by the checks until both are
    else:
        first, second = challenger, control
    rows = Checkpoint.objects.in_bulk([pk for pk in (first, second) if pk])
    plan.first = rows[first] if first else None
    plan.second = rows[second] if second else None


def _roles(plan: Plan) -> Roles:
    """Control and challenger of a draft, by id."""
    if plan.comparing == Comparing.CONTROL:
        return plan.first_id, None
    return plan.second_id, plan.first_id


def _told(pk: int | None, hidden: Collection[int]) -> str:
    return "" if pk is None else HIDDEN if pk in hidden else str(pk)


def _number(value: str) -> int | None:
    return int(value) if value else None
