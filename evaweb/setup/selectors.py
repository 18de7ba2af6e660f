"""Overview of what a lab has and what is missing, as cards: scenes, checkpoints, plans, people and stations."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from django.contrib.auth.models import User
from django.db.models import Count, QuerySet
from django.urls import reverse

from evaweb.accounts.roles import Role, role_of
from evaweb.blinding.visibility import Visibility
from evaweb.plans.models import PlanState
from evaweb.plans.selectors import plan_list
from evaweb.preflights.models import PreflightStatus, Verdict
from evaweb.preflights.selectors import preflight_list
from evaweb.stations.models import Station
from evaweb.trials.models import Scene
from evaweb.trials.selectors import checkpoint_list, scene_list


@dataclass(frozen=True, slots=True)
class Missing:
    """Message about something that is missing: a sentence, and the address of the form that adds it.

    `for_operators`: operators may use the form too, not only administrators.
    """

    text: str
    address: str
    for_operators: bool = False


@dataclass(frozen=True, slots=True)
class Card:
    """Card of one kind of thing: description, count, newest item, addresses of list and form, and what is missing."""

    title: str
    what: str
    count: int
    newest: str
    address: str
    add: str
    missing: tuple[Missing, ...]


def cards(*, user: Any, sight: Visibility) -> list[Card]:
    """Return the cards of scenes, checkpoints, plans, people and stations, without items hidden from the user."""
    return [_scenes(), _checkpoints(sight), _plans(user), _people(), _stations()]


def _scenes() -> Card:
    rows = scene_list(all_of_them=True).annotate(
        n_positions=Count("positions", distinct=True), n_milestones=Count("milestones", distinct=True)
    )
    missing = [problem for row in rows.filter(active=True) for problem in _missing_of(row)]
    if not rows.filter(active=True):
        missing.append(Missing("No scene is offered to operators.", reverse("setup-new-scene")))
    text = "What the robot is to do, from which positions, and what counts as success."
    return _card("Scenes", text, rows, reverse("setup-scenes"), reverse("setup-new-scene"), missing)


def _missing_of(scene: Any) -> Iterator[Missing]:
    address = reverse("setup-scene", args=[scene.name])
    if not scene.n_positions:
        yield Missing(f"{scene} has no position: no trial can begin.", f"{address}#positions")
    if not scene.n_milestones:
        yield Missing(
            f"{scene} has no milestone: its score is success or failure alone.", f"{address}#milestones"
        )
    if not scene.criterion:
        yield Missing(f"{scene} does not say what counts as success.", f"{address}#words")


def _checkpoints(visibility: Visibility) -> Card:
    rows = checkpoint_list(all_of_them=True, sight=visibility)
    usable = preflight_list(sight=visibility).filter(status=PreflightStatus.DONE, report__verdict=Verdict.OK)
    untried = rows.filter(active=True).exclude(pk__in=usable.values("checkpoint"))
    missing = [
        Missing(
            f"{row} has no successful preflight.",
            reverse("admin:trials_checkpoint_change", args=[row.pk]) + "#preflight",
        )
        for row in untried
    ]
    add = reverse("admin:trials_checkpoint_add")
    if not rows:
        missing.append(Missing("No checkpoint yet.", add))
    text = "Trained policies, and the addresses of their servers."
    return _card("Checkpoints", text, rows, reverse("admin:trials_checkpoint_changelist"), add, missing)


def _plans(user: Any) -> Card:
    rows = plan_list(user=user).annotate(
        n_positions=Count("positions", distinct=True), n_checkpoints=Count("checkpoints", distinct=True)
    )
    missing = []
    for row in rows.filter(state=PlanState.DRAFT):
        without = [
            name for name, n in (("position", row.n_positions), ("checkpoint", row.n_checkpoints)) if not n
        ]
        if without:
            edit = reverse("admin:plans_plan_change", args=[row.pk])
            missing.append(Missing(f"{row} has no {' and no '.join(without)}.", edit))
        else:
            page = reverse("result-plan", args=[row.name, row.version])
            missing.append(Missing(f"{row} is a draft: its trials begin once it is frozen.", page, True))
    add = reverse("result-plan-new")
    if not rows:
        missing.append(Missing("No plan yet: trials outside a plan answer no question.", add))
    text = "Questions, and the trials that answer them."
    return _card("Plans", text, rows, reverse("admin:plans_plan_changelist"), add, missing)


def _people() -> Card:
    rows = User.objects.filter(is_active=True).prefetch_related("groups").order_by("date_joined")
    working = [user for user in rows if role_of(user) is not Role.VIEWER]
    add = reverse("admin:auth_user_add")
    missing = []
    if len(working) < 2:
        only = (
            f"{working[0].get_username()} is the only one who runs and scores trials"
            if working
            else "Nobody runs trials"
        )
        missing.append(Missing(f"{only}: there is no second rater.", add))
    text = "Accounts, each with one role: viewer, operator or administrator."
    return _card("People", text, rows, reverse("admin:auth_user_changelist"), add, missing)


def _stations() -> Card:
    rows = Station.objects.order_by("created_at")
    missing = [
        Missing(
            f"{row} was never seen: start its runtime, or correct its name.",
            reverse("admin:stations_station_change", args=[row.pk]),
        )
        for row in rows.filter(active=True, boot="")
    ]
    add = reverse("admin:stations_station_add")
    if not rows:
        missing.append(Missing("No station yet.", add))
    text = "Robots on their benches, each with the runtime that moves it."
    return _card("Stations", text, rows, reverse("admin:stations_station_changelist"), add, missing)


def _card(title: str, text: str, rows: QuerySet[Any], address: str, add: str, missing: list[Missing]) -> Card:
    newest = max(rows, key=lambda row: row.pk, default=None)
    return Card(title, text, len(rows), str(newest or ""), address, add, tuple(missing))


def scene_rows() -> QuerySet[Scene]:
    """Return all scenes, offered ones first, annotated with the number of trials as `n_trials`."""
    rows = scene_list(all_of_them=True).annotate(n_trials=Count("trials", distinct=True))
    return rows.order_by("-active", "title")
