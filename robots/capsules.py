"""Capsules that approximate the links of a robot in checks for collisions with itself and the table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from robots import shapes
from robots.description import CapsuleTable
from robots.robot import Robot
from robots.rotations import Float64
from robots.shapes import Shape

PIECES = 2  # greatest number of capsules per link; more capsules make many more pairs
_ROUND = 24  # corners of the polygon around a circle
_STEPS = 100  # steps of the smallest circle
_about: dict[bytes, tuple[Capsule, ...]] = {}  # cache by the content of the shapes; some dozens per robot


@dataclass(frozen=True, slots=True, eq=False)
class Capsule:
    """Points within `radius` of the segment from `start` to `end`, float64 [3] in the link's frame [m].

    `finger` is True for a finger that does not move with its gripper.
    """

    start: Float64
    end: Float64
    radius: float
    finger: bool = False


def capsules(robot: Robot) -> dict[str, tuple[Capsule, ...]]:
    """Return the capsules by URDF link: declared in robot.toml, else computed from the link's shapes.

    Links without shapes, and links excluded in robot.toml, have none.
    """
    by_link: dict[str, list[Shape]] = {}
    for shape in shapes.read_shapes(robot.urdf):
        by_link.setdefault(shape.link, []).append(shape)
    by_name = {link: _remembered(link_shapes) for link, link_shapes in by_link.items()}
    by_name |= {link: tuple(map(_declared, tables)) for link, tables in robot.collision.capsules.items()}
    return {link: parts for link, parts in by_name.items() if link not in robot.collision.without}


def _remembered(link_shapes: Sequence[Shape]) -> tuple[Capsule, ...]:
    """Return the result of `covering_capsules` from a cache, because a station loads the same robot several times."""
    key = b"".join(_content(shape) for shape in link_shapes)
    if key not in _about:
        covering = covering_capsules(link_shapes)
        for capsule in covering:
            capsule.start.flags.writeable = capsule.end.flags.writeable = False
        _about[key] = covering
    return _about[key]


def _content(shape: Shape) -> bytes:
    lower, upper = shape.bounds()
    return f"{shape.kind} {shape.size}".encode() + b"".join(
        numbers.tobytes() for numbers in (shape.origin, lower, upper)
    )


def covering_capsules(shown: Sequence[Shape]) -> tuple[Capsule, ...]:
    """Return at most `PIECES` capsules that cover the shapes of one link; a bent link gets two instead of a thick one.

    Greedy merging: each shape starts with its own capsule; repeatedly, the pair of capsules whose common capsule adds
    the least volume is merged.
    """
    pieces = [[shape] for shape in shown]
    rooms = [_capsule_volume(piece) for piece in pieces]
    grown = {
        pair: _capsule_volume(pieces[pair[0]] + pieces[pair[1]])
        for pair in combinations(range(len(pieces)), 2)
    }
    left = set(range(len(pieces)))
    while len(left) > 1:
        i, j = min(
            combinations(sorted(left), 2), key=lambda pair: grown[pair] - rooms[pair[0]] - rooms[pair[1]]
        )
        if len(left) <= PIECES and grown[i, j] > rooms[i] + rooms[j]:
            break
        left -= {i, j}
        joined = len(pieces)
        pieces.append(pieces[i] + pieces[j])
        rooms.append(grown[i, j])
        grown |= {(piece, joined): _capsule_volume(pieces[piece] + pieces[joined]) for piece in left}
        left.add(joined)
    return tuple(smallest_capsule(pieces[piece]) for piece in sorted(left))


def _capsule_volume(link_shapes: Sequence[Shape]) -> float:
    """Return the volume of a capsule around the shapes [m3]."""
    capsule = smallest_capsule(link_shapes, steps=1)
    length = float(np.linalg.norm(capsule.end - capsule.start))
    return float(np.pi * capsule.radius**2 * (length + 4 / 3 * capsule.radius))


def smallest_capsule(shown: Sequence[Shape], steps: int = _STEPS) -> Capsule:
    """Return a capsule that covers the shapes, along the longest axis of their bounding box.

    Its line passes through the centre of the smallest circle around the shapes as they appear along that axis (more
    accurate with more `steps`); its ends are as close together as possible. The fit is tight for round shapes; for
    boxes the capsule extends beyond the faces.
    """
    centres, sizes = _balls(shown)  # [n, 3], [n]
    lower, upper = (centres - sizes[:, None]).min(axis=0), (centres + sizes[:, None]).max(axis=0)
    axis = int((upper - lower).argmax())
    across = np.delete(np.arange(3), axis)
    middle = _smallest_circle(centres[:, across], sizes, (lower + upper)[across] / 2, steps)
    off = np.linalg.norm(centres[:, across] - middle, axis=1)
    radius = float((off + sizes).max())
    # A ball at distance `off` from the line is covered if the end is at most this far from it along the line.
    reach = np.sqrt(np.maximum((radius - sizes) ** 2 - off**2, 0.0))
    along = centres[:, axis]
    first, last = float((along + reach).min()), float((along - reach).max())
    start, end = np.zeros(3), np.zeros(3)
    start[across] = end[across] = middle
    start[axis], end[axis] = (first, last) if first <= last else ((first + last) / 2,) * 2
    return Capsule(start, end, radius)


def _declared(table: CapsuleTable) -> Capsule:
    return Capsule(np.array(table.start), np.array(table.end), table.radius, table.finger)


def _balls(link_shapes: Sequence[Shape]) -> tuple[Float64, Float64]:
    """Return balls whose convex hull covers the shapes: centres [n, 3] in the link's frame, and radii [n].

    A shape with corners is represented by balls of radius 0 at its corners.
    """
    centres, sizes = [], []
    for shape in link_shapes:
        corners, size = _corners(shape)
        centres.append(corners @ shape.origin[:3, :3].T + shape.origin[:3, 3])
        sizes.append(np.full(len(corners), size))
    return np.concatenate(centres), np.concatenate(sizes)


def _corners(shape: Shape) -> tuple[Float64, float]:
    if shape.kind == "sphere":
        return np.zeros((1, 3)), shape.size[0]
    if shape.kind == "cylinder":
        radius, length = shape.size
        turn = np.linspace(0.0, 2 * np.pi, _ROUND, endpoint=False)
        ring = np.column_stack([np.cos(turn), np.sin(turn)]) * radius / np.cos(np.pi / _ROUND)
        ends = np.repeat([-length / 2, length / 2], _ROUND)
        return np.column_stack([np.tile(ring, (2, 1)), ends]), 0.0
    return shape.box_corners(), 0.0


def _smallest_circle(points: Float64, sizes: Float64, start: Float64, steps: int) -> Float64:
    """Return the centre of the smallest circle around discs [n, 2], computed iteratively (Badoiu and Clarkson 2003)."""
    middle, best, least = start, start, np.inf
    for step in range(1, steps + 1):
        off = points - middle
        far = np.linalg.norm(off, axis=1) + sizes
        worst = int(far.argmax())
        if far[worst] < least:
            best, least = middle, far[worst]
        middle = middle + off[worst] / (step + 1)
    return best
