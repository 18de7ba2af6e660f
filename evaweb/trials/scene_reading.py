"""Scene with positions and milestones as one table, and the trials and plans that use them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from typing import Annotated, Any

from django.db import models
from django.db.models import Count, Q
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from evaweb.serving.error_pages import is_text
from evaweb.trials.models import Scene
from runtime.benches.schema import DEFAULT_BENCH

_FROZEN = ("frozen", "closed", "revealed")  # states of plans; evaweb.plans defines the relation
FIELDS = (
    *("title", "instruction", "criterion", "layout", "bench"),
    *("time_limit_s", "ordered", "failure_required", "active"),
)
POSITION = ("number", "label", "description", "bench")
MILESTONE = ("text", "points", "required", "time_limit_s", "truth")


def _kept(text: str) -> str:
    if not is_text(text):
        raise ValueError("allowed: text without NUL and half characters")
    return text


_Text = Annotated[str, AfterValidator(_kept)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, str_strip_whitespace=True)


class PositionTable(_Table):
    """Position of a scene; `id` is None for a new position."""

    id: int | None = None
    number: int = Field(ge=0, lt=2**15)
    label: _Text = ""
    description: _Text = ""
    bench: dict[str, Any] | None = None


class MilestoneTable(_Table):
    """Milestone of a scene, at its place in the list; `id` is None for a new milestone."""

    id: int | None = None
    text: _Text = ""
    points: int = 1
    required: bool = False
    time_limit_s: float | None = None
    truth: _Text = ""


class SceneTable(_Table):
    """Scene with its positions and milestones, as it is to be written."""

    name: _Text = ""
    title: _Text = ""
    instruction: _Text = ""
    criterion: _Text = ""
    layout: _Text = ""
    bench: _Text = DEFAULT_BENCH
    time_limit_s: float | None = None
    ordered: bool = False
    failure_required: bool = False
    active: bool = True
    positions: Annotated[list[PositionTable], Field(max_length=500)] = []
    milestones: Annotated[list[MilestoneTable], Field(max_length=100)] = []


def scene_table(scene: Scene) -> dict[str, Any]:
    """Return the scene as plain values, in the form that `scene_write` takes."""
    return {
        "name": scene.name,
        **{name: getattr(scene, name) for name in FIELDS},
        "positions": [values_of(row, ("id", *POSITION)) for row in scene.positions.order_by("number")],
        "milestones": [values_of(row, ("id", *MILESTONE)) for row in scene.milestones.order_by("order")],
    }


def scene_digest(scene: Scene) -> str:
    """Return a digest of the scene as stored, which changes with any part of it."""
    table = scene_table(Scene.objects.get(pk=scene.pk))
    return hashlib.sha256(json.dumps(table, sort_keys=True).encode()).hexdigest()[:32]


def protected_positions(scene: Scene) -> dict[int, str]:
    """Return by id the positions used by trials or frozen plans, with the reason as text."""
    referred = Q(trials__isnull=False) | Q(plan__state__in=_FROZEN)
    rows = scene.positions.filter(referred).annotate(n=Count("trials", distinct=True)).distinct()
    reasons = {}
    for row in rows.prefetch_related("plan_set"):
        plans = [str(plan) for plan in row.plan_set.all() if plan.state in _FROZEN]  # type: ignore[attr-defined]
        trials = [f"{row.n} trial{'s' if row.n > 1 else ''}"] if row.n else []
        reasons[row.pk] = " and ".join([*trials, *(f"plan {plan}" for plan in plans)])
    return reasons


def running_plans(scene: Scene) -> list[str]:
    """Return the titles of running plans that use the scene."""
    rows = scene.positions.filter(plan__state="frozen").order_by("plan__title", "plan__version")
    versions = rows.values_list("plan__title", "plan__version").distinct()
    return [f"{title} v{version}" for title, version in versions]


def values_of(row: models.Model, names: Iterable[str]) -> dict[str, Any]:
    return {name: getattr(row, name) for name in names}
