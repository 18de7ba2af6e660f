"""Layout of blocks and plate on the simulated bench: drawn from a seed, near requested places if there are any."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from runtime.simulation.bench.bench import TABLETOP, BenchError, BenchLayout

NOISE_M = 0.005  # largest deviation from a requested place, in x and in y
NOISE_RAD = math.radians(4.0)
APART_M = TABLETOP.distance("block", "plate")  # least distance, centre to centre
_TRIES = 1000


def draw_layout(seed: int, positions: Mapping[str, Any] | None = None, blocks: int = 1) -> BenchLayout:
    """Return the layout that `seed` decides, the same for the same arguments.

    `positions` may request places of the task's block ("block": [x, y, yaw in degrees]) and of the plate ("plate": [x,
    y]); the objects are then placed within NOISE_M and NOISE_RAD of them. An object without a request is placed at
    random, but so that block and plate are reachable from one side of the bench.

    Raises:
        BenchError: If `positions` has another form, is outside the area or has block and plate closer than APART_M, if
            `blocks` is below 1 or does not fit, or if the seed is negative.
    """
    block, plate = _parse_positions(positions or {})
    if blocks < 1 or seed < 0:
        raise BenchError(f"{blocks} blocks by seed {seed} were asked for; allowed: one or more, from 0 on")
    chance = np.random.default_rng(seed)
    placed_block, placed_plate = _pair(chance, block, plate)
    placed = [placed_block]
    for _ in range(blocks - 1):
        placed.append(_distractor(chance, placed, placed_plate))
    return BenchLayout(tuple(placed), placed_plate)


def _parse_positions(positions: Mapping[str, Any]) -> tuple[list[float] | None, list[float] | None]:
    """Return the requested places of block (x, y, yaw in rad) and plate (x, y)."""
    given = {name: place for name, place in positions.items() if place is not None}
    if problem := next(TABLETOP.problems(given), ""):
        raise BenchError(f"positions: {problem}")
    placed = {name: [float(number) for number in place] for name, place in given.items()}
    block, plate = placed.get("block"), placed.get("plate")
    if block is not None:
        block[2] = math.radians(block[2])
    return block, plate


def _pair(
    chance: np.random.Generator, block: list[float] | None, plate: list[float] | None
) -> tuple[tuple[float, float, float], tuple[float, float]]:
    """Return places of block and plate, each drawn at random, or near its requested place if there is one.

    Unless both are requested, they are drawn again until they are far enough apart and reachable from one side.
    """
    for _ in range(_TRIES):
        block_x, block_y, yaw = _random_place(chance) if block is None else _random_near(chance, block)
        plate_x, plate_y, _ = _random_place(chance) if plate is None else _random_near(chance, [*plate, 0.0])
        requested = block is not None and plate is not None
        apart = math.dist((block_x, block_y), (plate_x, plate_y)) >= APART_M
        if requested or (apart and _one_side((block_x, block_y), (plate_x, plate_y))):
            return (block_x, block_y, yaw), (plate_x, plate_y)
    raise BenchError(f"no place was found beside block {block}, plate {plate}; allowed: other positions")


def _one_side(*places: tuple[float, float]) -> bool:
    reach = TABLETOP.reach
    return any(all(math.dist(side, place) <= reach.distance for place in places) for side in reach.sides)


def _random_place(chance: np.random.Generator) -> tuple[float, float, float]:
    x_from, x_to, y_from, y_to = TABLETOP.area
    x, y = chance.uniform((x_from, y_from), (x_to, y_to))
    return float(x), float(y), float(chance.uniform(-math.pi / 4, math.pi / 4))


def _random_near(chance: np.random.Generator, place: list[float]) -> tuple[float, float, float]:
    noise = chance.uniform(-1.0, 1.0, 3) * (NOISE_M, NOISE_M, NOISE_RAD)
    x, y, yaw = np.add(place, noise)
    return float(x), float(y), float(yaw)


def _distractor(
    chance: np.random.Generator, placed: list[tuple[float, float, float]], plate: tuple[float, float]
) -> tuple[float, float, float]:
    crowd = TABLETOP.distractors.distance
    for _ in range(_TRIES):
        x, y, yaw = _random_place(chance)
        clear = all(math.dist((x, y), taken_place[:2]) >= crowd for taken_place in placed)
        if clear and math.dist((x, y), plate) >= APART_M:
            return x, y, yaw
    raise BenchError(f"no place was found for block {len(placed) + 1}; allowed: fewer blocks")
