"""Layout of the objects on the simulated bench: drawn from a seed, near requested places if there are any."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from runtime.benches.schema import BenchSchema
from runtime.simulation.bench.bench import TABLETOP, BenchError, BenchLayout

NOISE_M = 0.005  # largest deviation from a requested place, in x and in y
NOISE_RAD = math.radians(4.0)
_TRIES = 1000  # of one object, or of a group that one arm has to reach
_RESTARTS = 20  # of a whole layout

Place = tuple[float, float, float]  # x, y, yaw [m, rad]


def draw_layout(
    seed: int,
    positions: Mapping[str, Any] | None = None,
    blocks: int = 1,
    schema: BenchSchema = TABLETOP,
) -> BenchLayout:
    """Return the layout that `seed` decides, the same for the same arguments.

    `positions` may request places of objects: a box has [x, y, yaw in degrees], a disc [x, y]; the objects are then
    placed within NOISE_M and NOISE_RAD of them. An object without a request is placed at random, but so that an arm
    reaches it, and one arm all objects of a group of the schema. With more than one of `blocks` there are so many
    distractors fewer by one.

    Raises:
        BenchError: If `positions` has another form, is outside the area or has objects too close to each other, if
            `blocks` is below 1 or does not fit, or if the seed is negative.
    """
    if blocks < 1 or seed < 0:
        raise BenchError(f"{blocks} blocks by seed {seed} were asked for; allowed: one or more, from 0 on")
    drawing = _Drawing(seed, _parse_positions(positions or {}, schema), schema)
    placed = drawing.draw()
    boxes = [placed[name] for name in schema.boxes]
    for _ in range(blocks - 1):
        boxes.append(drawing.draw_distractor(boxes, placed))
    return BenchLayout(tuple(boxes), tuple(placed[name][:2] for name in schema.discs))


def _parse_positions(positions: Mapping[str, Any], schema: BenchSchema) -> dict[str, Place]:
    """Return the requested places by name (x, y, yaw in rad)."""
    given = {name: place for name, place in positions.items() if place is not None}
    if problem := next(schema.problems(given), ""):
        raise BenchError(f"positions: {problem}")
    places = {}
    for name, place in given.items():
        x, y, *yaw = map(float, place)
        places[name] = (x, y, math.radians(yaw[0]) if yaw else 0.0)
    return places


class _Drawing:
    """Drawing of one layout: groups that one arm has to reach come first, then the other discs, then the other
    boxes.
    """

    def __init__(self, seed: int, requested: Mapping[str, Place], schema: BenchSchema) -> None:
        self._chance = np.random.default_rng(seed)
        self._requested, self._schema = requested, schema
        grouped = [name for group in schema.together for name in group]
        single = [[name] for name in (*schema.discs, *schema.boxes) if name not in grouped]
        self._groups: Sequence[Sequence[str]] = [*schema.together, *single]

    def draw(self) -> dict[str, Place]:
        """Return the place of every object of the schema."""
        for _ in range(_RESTARTS):
            placed: dict[str, Place] = {}
            for group in self._groups:
                found = self._draw_group(group, placed)
                if found is None:
                    break
                placed |= found
            else:
                return placed
        beside = ", ".join(f"{name} {place[:2]}" for name, place in self._requested.items())
        raise BenchError(f"no place was found beside {beside or 'each other'}; allowed: other positions")

    def _draw_group(self, group: Sequence[str], placed: Mapping[str, Place]) -> dict[str, Place] | None:
        """Return places of a group beside those that are `placed`; None if none was found.

        Each is drawn at random, or near its requested place if there is one. Unless all of them are requested, they are
        drawn again until they are far enough from everything and reachable by one arm.
        """
        requested = all(name in self._requested for name in group)
        for _ in range(_TRIES):
            found = {name: self._draw_place(name) for name in group}
            if requested or (self._are_apart(found, placed) and self._are_reachable(found)):
                return found
        return None

    def _draw_place(self, name: str) -> Place:
        wish = self._requested.get(name)
        return (
            self._random_place(self._schema.objects[name].area) if wish is None else self._random_near(wish)
        )

    def _are_apart(self, found: Mapping[str, Place], placed: Mapping[str, Place]) -> bool:
        everything = {**placed, **found}
        return all(
            math.dist(everything[one][:2], everything[other][:2]) >= least
            for one, other, least in self._schema.distances
            if one in everything and other in everything and (one in found or other in found)
        )

    def _are_reachable(self, found: Mapping[str, Place]) -> bool:
        reach = self._schema.reach
        return any(
            all(math.dist(side, place[:2]) <= reach.distance for place in found.values())
            for side in reach.sides
        )

    def _random_place(self, area: Sequence[float] | None = None) -> Place:
        x_from, x_to, y_from, y_to = area or self._schema.area
        x, y = self._chance.uniform((x_from, y_from), (x_to, y_to))
        return float(x), float(y), float(self._chance.uniform(-math.pi / 4, math.pi / 4))

    def _random_near(self, place: Place) -> Place:
        noise = self._chance.uniform(-1.0, 1.0, 3) * (NOISE_M, NOISE_M, NOISE_RAD)
        x, y, yaw = np.add(place, noise)
        return float(x), float(y), float(yaw)

    def draw_distractor(self, boxes: Sequence[Place], placed: Mapping[str, Place]) -> Place:
        """Return the place of a further block. Raises: BenchError if there is none."""
        schema, first = self._schema, next(iter(self._schema.boxes))
        for _ in range(_TRIES):
            x, y, yaw = self._random_place()
            clear = all(math.dist((x, y), box[:2]) >= schema.distractors.distance for box in boxes)
            if clear and all(
                math.dist((x, y), placed[disc][:2]) >= schema.distance(first, disc) for disc in schema.discs
            ):
                return x, y, yaw
        raise BenchError(f"no place was found for block {len(boxes) + 1}; allowed: fewer blocks")
