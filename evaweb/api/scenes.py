"""Scenes with their positions and milestones."""

from __future__ import annotations

from typing import Any

from django.http import HttpRequest
from ninja import Query, Router, Schema

from evaweb.api.responses import FAILURES, Page, Paging
from evaweb.trials import selectors
from evaweb.trials.models import Scene

router = Router(tags=["scenes"])


class PositionOut(Schema):
    """One initial condition."""

    id: int
    number: int
    label: str
    description: str
    bench: dict[str, Any] | None


class MilestoneOut(Schema):
    """One step towards success; `truth` is its name in the ground truth of a simulated bench."""

    id: int
    order: int
    text: str
    points: int
    required: bool
    time_limit_s: float | None
    truth: str


class SceneOut(Schema):
    """A task on a bench."""

    id: int
    name: str
    title: str
    instruction: str
    criterion: str
    layout: str
    bench: str
    time_limit_s: float | None
    ordered: bool
    failure_required: bool
    active: bool
    positions: list[PositionOut]
    milestones: list[MilestoneOut]

    @staticmethod
    def of(scene: Scene) -> Scene:
        """Return the row unchanged: its attributes have the names of the schema's fields."""
        return scene


@router.get("", response={200: Page[SceneOut], **FAILURES}, summary="Scenes", url_name="scenes")
def scenes(request: HttpRequest, paging: Query[Paging], inactive: bool = False) -> Any:
    """Return the scenes that operators may choose; with `inactive` also those that are switched off."""
    return paging.page(selectors.scene_list(all_of_them=inactive), SceneOut)


@router.get("/{name}", response={200: SceneOut, **FAILURES}, summary="One scene", url_name="scene")
def scene(request: HttpRequest, name: str) -> Any:
    """Return a scene by its name or its id."""
    return selectors.scene_get(name=name)
