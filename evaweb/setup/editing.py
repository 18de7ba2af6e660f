"""Context of the scene editor: the scene as plain values, its bench, and the operator's view."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

from django.http import HttpRequest
from django.template.loader import render_to_string
from django.urls import reverse

from evaweb.plans.bench_checks import cameras_of
from evaweb.plans.models import Reference
from evaweb.stations.models import Station
from evaweb.stations.selectors import station_list
from evaweb.trials.failures import failure_choices
from evaweb.trials.models import Milestone, Position, Scene
from evaweb.trials.scene_reading import (
    MilestoneTable,
    PositionTable,
    SceneTable,
    protected_positions,
    running_plans,
    scene_digest,
    scene_table,
)
from evaweb.trials.scene_writing import table_of
from evaweb.trials.tables import BENCH, EXAMPLE
from runtime.benches.schema import Box, Disc


def _size(thing: Box | Disc) -> dict[str, Any]:
    """Return how an object of the simulated bench is drawn from above: lengths in m."""
    width, depth = thing.size[:2] if isinstance(thing, Box) else (2 * thing.radius, 2 * thing.radius)
    return {
        "title": thing.title,
        "round": isinstance(thing, Disc),
        "width": width,
        "depth": depth,
        "example": thing.example,
    }


# The simulated bench, with lengths in m, and position and reach of its arms.
SIZES = {
    "area": BENCH.area,
    "apart": BENCH.distances,
    "sides": BENCH.reach.sides,
    "reach": BENCH.reach.distance,
    "objects": {name: _size(thing) for name, thing in BENCH.objects.items()},
    "factors": {name: factor.model_dump() for name, factor in BENCH.factors.items()},
}

# Corners of the area in 4:3 images of the simulated overhead camera, as shares of width and height: near left, near
# right, far right, far left. A test compares them with the simulation.
OVERHEAD = [[0.2454, 0.6381], [0.7546, 0.6381], [0.7616, 0.2951], [0.2384, 0.2951]]


def shown(scene: Scene) -> dict[str, Any]:
    """Return the data for drawings of the positions; a position without a layout has its reference image, if any."""
    pictures = _references(scene)
    positions = [
        {
            "number": row.number,
            "label": row.label,
            "bench": row.bench,
            "picture": next((reference["picture"] for reference in pictures.get(row.pk, ())), ""),
        }
        for row in scene.positions.all()
    ]
    return {"title": scene.title, "bench": SIZES, "positions": positions}


def state_of(scene: Scene) -> dict[str, Any]:
    """Return the saved scene, its version, and the positions that cannot be changed, by id, with the reason."""
    return {"scene": scene_table(scene), "seen": scene_digest(scene), "kept": protected_positions(scene)}


def existing(scene: Scene) -> dict[str, Any]:
    """Return the context of the editor for an existing scene."""
    state = {**state_of(scene), "references": _references(scene), **_around()}
    return {
        "scene": scene,
        "state": state,
        "trials": scene.trials.count(),
        "plans": running_plans(scene),
    }


def new(source: Scene | None) -> dict[str, Any]:
    """Return the context of the editor for a new scene, as a copy of `source` if given."""
    table = scene_table(source) if source else SceneTable().model_dump()
    table["name"] = ""
    table["title"] = f"{source.title} (copy)" if source else ""
    for row in (*table["positions"], *table["milestones"]):
        row["id"] = None
    if source is None:
        laid = EXAMPLE if station_list().filter(simulated=True).exists() else None
        table["positions"] = [PositionTable(number=1, bench=laid).model_dump()]
    state = {"scene": table, "seen": "", "kept": {}, "references": {}, **_around()}
    return {"scene": None, "source": source, "state": state, "trials": 0, "plans": []}


def _around() -> dict[str, Any]:
    stations = [
        {"name": row.name, "title": str(row), "cameras": cameras_of(row), "corners": _corners(row)}
        for row in station_list()
    ]
    addresses = {
        "preview": reverse("setup-preview"),
        "live": reverse("setup-live", args=["STATION", "CAMERA"]),
    }
    return {"bench": SIZES, "stations": stations, "addresses": addresses}


def _corners(station: Station) -> dict[str, Any]:
    """Return, for each camera known to look from above, the corners of the bench's area in its image.

    They are shares of the image's width and height.
    """
    above = [camera for camera in cameras_of(station) if station.simulated and "wrist" not in camera]
    return dict.fromkeys(above, OVERHEAD)


def _references(scene: Scene) -> dict[int, list[dict[str, str]]]:
    """Return by position id the newest reference image of each camera of each station."""
    newest = {
        (row.position_id, row.station.name, row.camera): row
        for row in Reference.objects.filter(position__scene=scene).select_related("station").order_by("pk")
    }
    by_position: dict[int, list[dict[str, str]]] = defaultdict(list)
    for (position, station, camera), row in sorted(newest.items()):
        picture, page = reverse("picture", args=[row.picture]), reverse("reference", args=[row.pk])
        by_position[position].append({"station": station, "camera": camera, "picture": picture, "page": page})
    return dict(by_position)


# --- the operator's view -------------------------------------------------------------------------------------


def operators_view(request: HttpRequest, given: Any, position: Any) -> str:
    """Return the set-up and score cards of one position of a scene, rendered by the Eval page's templates.

    `given` is the scene, `position` the index of the position in it.
    """
    table = table_of(given)
    scene = Scene(**table.model_dump(exclude={"positions", "milestones"}))
    milestones = [
        Milestone(pk=place, order=place, **_fields(row))
        for place, row in enumerate(table.milestones, start=1)
    ]
    rows = [Position(scene=scene, **_fields(row)) for row in table.positions]
    chosen = rows[position] if isinstance(position, int) and 0 <= position < len(rows) else Position()
    trial = {"scene": scene, "position": chosen, "pk": 0}
    panel = {
        "milestones": milestones,
        "implied": any(row.required for row in milestones),
        "failures": failure_choices(),
        "layout": scene.layout,
        "hidden": True,
    }
    common = {"panel": panel, "station": {"simulated": False}}
    parts = (("setup", "prepared"), ("score", "ended"))
    return "".join(
        render_to_string(
            f"console/step_{step}.html", {**common, "trial": {**trial, "status": status}}, request
        )
        for step, status in parts
    )


def _fields(row: PositionTable | MilestoneTable) -> dict[str, Any]:
    return row.model_dump(exclude={"id"})
