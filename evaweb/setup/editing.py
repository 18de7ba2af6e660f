"""Context of the scene editor: the scene as plain values, its bench, and the operator's view."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from django.http import HttpRequest
from django.template.loader import render_to_string
from django.urls import reverse
from django.utils.text import slugify

from evaweb.core.errors import EvaError
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
from evaweb.trials.tables import example_layout
from runtime.benches.schema import (
    DEFAULT_BENCH,
    BenchSchema,
    Box,
    Disc,
    UnusableBench,
    installed_benches,
    load_schema,
)


def _size(thing: Box | Disc, *, coloured: bool) -> dict[str, Any]:
    """Return how an object of the simulated bench is drawn from above: lengths in m.

    Its own colours are drawn if `coloured`.
    """

    def shade(colour: Sequence[int]) -> str:
        return "#{:02x}{:02x}{:02x}".format(*colour) if coloured else ""

    width, depth = thing.size[:2] if isinstance(thing, Box) else (2 * thing.radius, 2 * thing.radius)
    return {
        "title": thing.title,
        "round": isinstance(thing, Disc),
        "width": width,
        "depth": depth,
        "example": thing.example,
        "colour": shade(thing.colour),
        "rim": shade(thing.rim_colour) if isinstance(thing, Disc) else "",
    }


def sizes_of(schema: BenchSchema) -> dict[str, Any]:
    """Return a simulated bench as it is drawn and edited: lengths in m, position and reach of its arms.

    Where several boxes or discs have to be told apart, they have their own colours, else those of the page.
    """
    coloured = len(schema.boxes) > 1 or len(schema.discs) > 1
    return {
        "area": schema.area,
        "apart": schema.distances,
        "sides": schema.reach.sides,
        "reach": schema.reach.distance,
        "objects": {name: _size(thing, coloured=coloured) for name, thing in schema.objects.items()},
        "factors": {name: factor.model_dump() for name, factor in schema.factors.items()},
        "program": schema.program is not None,
        "choices": {name: choice.model_dump() for name, choice in schema.choices.items()},
    }


def _drawn(scene: Scene) -> tuple[BenchSchema, dict[str, Any], str]:
    """Return the scene's bench, how it is drawn, and "".

    If its folder is absent or invalid, return the default bench without objects, and the reason: the scene can still
    be looked at, and its bench corrected.
    """
    try:
        return scene.schema, sizes_of(scene.schema), ""
    except UnusableBench as error:
        schema = load_schema(DEFAULT_BENCH)
        return (
            schema,
            sizes_of(schema) | {"objects": {}, "factors": {}, "choices": {}, "apart": []},
            str(error),
        )


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
    return {"title": scene.title, "bench": _drawn(scene)[1], "positions": positions}


def state_of(scene: Scene) -> dict[str, Any]:
    """Return the saved scene, its version, and the positions that cannot be changed, by id, with the reason."""
    return {"scene": scene_table(scene), "seen": scene_digest(scene), "kept": protected_positions(scene)}


def existing(scene: Scene) -> dict[str, Any]:
    """Return the context of the editor for an existing scene."""
    schema, sizes, problem = _drawn(scene)
    state = {**state_of(scene), "references": _references(scene), "bench": sizes, **_around(schema)}
    return {
        "scene": scene,
        "bench": scene.bench,
        "bench_problem": problem,
        "truths": _truths(scene.bench, schema),
        "state": state,
        "trials": scene.trials.count(),
        "plans": running_plans(scene),
    }


def new(source: Scene | None, bench: str = "") -> dict[str, Any]:
    """Return the context of the editor for a new scene, as a copy of `source` if given.

    A scene for the simulated bench `bench` begins with that bench's task; "" is the default bench, without a task.
    Raises: EvaError if there is no such bench.
    """
    name = source.bench if source else bench or DEFAULT_BENCH
    try:
        schema = load_schema(name)
    except UnusableBench as error:
        raise EvaError(str(error)) from None
    table = scene_table(source) if source else SceneTable().model_dump()
    table["name"] = ""
    table["title"] = f"{source.title} (copy)" if source else ""
    for row in (*table["positions"], *table["milestones"]):
        row["id"] = None
    table["bench"] = name
    if source is None:
        simulated = bench or station_list().filter(simulated=True).exists()
        laid = example_layout(schema) if simulated else None
        table["positions"] = [PositionTable(number=1, bench=laid).model_dump()]
    if source is None and bench:
        table["title"], table["instruction"] = schema.title, schema.instruction
        table["name"] = slugify(schema.title)
        rows = {truth: schema.milestones[truth] for truth in schema.success}
        table["milestones"] = [
            MilestoneTable(text=row.text, required=True, truth=truth).model_dump()
            for truth, row in rows.items()
        ]
    around = {"bench": sizes_of(schema), **_around(schema)}
    state = {"scene": table, "seen": "", "kept": {}, "references": {}, **around}
    return {
        "scene": None,
        "source": source,
        "bench": name,
        "benches": known_benches(),
        "truths": _truths(name, schema),
        "state": state,
        "trials": 0,
        "plans": [],
    }


def known_benches() -> list[str]:
    """Return the installed benches, then those of scenes, each once."""
    used = Scene.objects.order_by("bench").values_list("bench", flat=True).distinct()
    return list(dict.fromkeys([*installed_benches(), *used]))


def _truths(bench: str, schema: BenchSchema) -> list[tuple[str, str]]:
    """Return (name, text) of what a bench reports; of the default bench, whose texts the page has itself, nothing."""
    if bench == DEFAULT_BENCH:
        return []
    return [(name, milestone.text) for name, milestone in schema.milestones.items()]


def _around(schema: BenchSchema) -> dict[str, Any]:
    stations = [
        {"name": row.name, "title": str(row), "cameras": cameras_of(row), "corners": _corners(row, schema)}
        for row in station_list()
    ]
    addresses = {
        "preview": reverse("setup-preview"),
        "live": reverse("setup-live", args=["STATION", "CAMERA"]),
    }
    return {"stations": stations, "addresses": addresses}


def _corners(station: Station, schema: BenchSchema) -> dict[str, Any]:
    """Return, for each camera known to look from above, the corners of the bench's area in its image.

    They are shares of the image's width and height, and known for benches with the default bench's area alone.
    """
    if schema.area != load_schema(DEFAULT_BENCH).area:
        return {}
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
