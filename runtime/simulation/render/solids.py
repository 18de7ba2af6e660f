"""Solids as vertices and convex flat faces, each fixed in a moving frame: boxes, cylinders, spheres, plates, table."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.core.types import Float64
from runtime.simulation.bench.bench import DiscShape
from runtime.simulation.render.rasteriser import GROUND, LACQUER, SHADED, Geometry, place

Face = tuple[int, ...]
_SIDES = 16  # of a short cylinder, and of a sphere
_MANY_SIDES, _LONG = 24, 0.05  # sides of cylinders of this length [m] or more
_RINGS = 6  # bands of a sphere, from pole to pole
_DISC_SIDES = 64
_DISC_RINGS = (  # share of the radius, share of the height, brightness of the ring up to the next; 0: the rim's colour
    (0.92, 0.0, 0.0),
    (1.0, 1.0, 0.0),
    (0.93, 0.95, 0.97),
    (0.90, 0.90, 0.86),
    (0.72, 0.35, 0.93),
    (0.70, 0.33, 1.0),
)
_SIDE_TONE = 0.55  # brightness of a disc's outer side relative to its rim
_BOX = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_BOX_FACES: tuple[Face, ...] = (
    (0, 1, 3, 2),
    (4, 6, 7, 5),
    (0, 4, 5, 1),
    (2, 3, 7, 6),
    (0, 2, 6, 4),
    (1, 5, 7, 3),
)


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """Solid in frame `frame`: vertices [n, 3] in metres, and faces with corners counter-clockwise seen from outside.

    `colours` [faces, 3] or [3] are blue, green, red, 0 to 255; `finish` is one of the rasteriser's.
    """

    frame: int
    vertices: Float64
    faces: Sequence[Face]
    colours: Float64
    finish: int = LACQUER


class Solids:
    """Solids as the rasteriser needs them: S solids, V vertices, F faces."""

    def __init__(self, solids: Sequence[Solid]) -> None:
        starts = _bounds([len(solid.vertices) for solid in solids])
        faces = [
            np.add(face, start)
            for solid, start in zip(solids, starts[:-1], strict=True)
            for face in solid.faces
        ]
        vertices = np.concatenate([solid.vertices for solid in solids])
        counts = [len(solid.faces) for solid in solids]
        self.geometry = Geometry(
            vertices=vertices,
            starts=starts,
            frames=np.array([solid.frame for solid in solids]),
            face_starts=_bounds([len(face) for face in faces]),
            corners=np.concatenate(faces),
            face_solids=np.repeat(np.arange(len(solids)), counts),
            normals=np.array([_normal(vertices[face]) for face in faces]),
            colours=np.concatenate(
                [np.broadcast_to(solid.colours, (len(solid.faces), 3)) for solid in solids]
            ),
            finishes=np.repeat([solid.finish for solid in solids], counts),
        )

    def placed(self, poses: Float64) -> tuple[Float64, Float64]:
        """Return vertices [V, 3] and normals [F, 3] in the world for the frames' poses, world <- frame [N, 4, 4]."""
        vertices, normals = np.empty_like(self.geometry.vertices), np.empty_like(self.geometry.normals)
        place(self.geometry, poses, vertices, normals)
        return vertices, normals


def shape_solid(
    frame: int,
    kind: str,
    size: tuple[float, ...],
    origin: Float64,
    colour: tuple[float, ...],
    finish: int = LACQUER,
) -> Solid:
    """Return a box (x, y, z), a cylinder (radius, length along z) or a sphere (radius,), in metres.

    `origin` [4, 4] is the pose of its centre in its frame; `colour` is red, green, blue, 0 to 1.
    """
    vertices, faces = _SHAPES[kind](*size)
    colours = 255 * np.array(colour[2::-1])
    return Solid(frame, vertices @ origin[:3, :3].T + origin[:3, 3], faces, colours, finish)


def disc_solid(frame: int, disc: DiscShape) -> Solid:
    """Return a plate on the table: outer side, coloured rim, inward slope and flat middle."""
    rings = [
        np.column_stack(
            [_circle(disc.radius * share, _DISC_SIDES), np.full(_DISC_SIDES, disc.height * level)]
        )
        for share, level, _ in _DISC_RINGS
    ]
    rim, inside = np.array(disc.rim_colour[::-1], float), np.array(disc.colour[::-1], float)
    tones = [_SIDE_TONE * rim, rim, *(tone * inside for _, _, tone in _DISC_RINGS[2:])]
    last = len(rings) - 1
    faces = [face for ring in range(last) for face in _belt(ring * _DISC_SIDES, _DISC_SIDES)]
    middle = tuple(range(last * _DISC_SIDES, (last + 1) * _DISC_SIDES))
    colours = np.vstack([np.repeat(tones[:-1], _DISC_SIDES, axis=0), tones[-1]])
    return Solid(frame, np.concatenate(rings), [*faces, middle], colours, SHADED)


def table_solid(frame: int, x: tuple[float, float], y: tuple[float, float]) -> Solid:
    """Return the table's surface at z = 0 within the bounds `x` and `y` [m], visible from both sides."""
    corners = np.array([[x[0], y[0], 0.0], [x[1], y[0], 0.0], [x[1], y[1], 0.0], [x[0], y[1], 0.0]])
    return Solid(frame, corners, [(0, 1, 2, 3), (3, 2, 1, 0)], np.zeros(3), GROUND)


def _bounds(counts: Sequence[int]) -> NDArray[np.int64]:
    """Return where each of consecutive pieces starts, and where the last ends."""
    return np.cumsum([0, *counts])


def _box(*size: float) -> tuple[Float64, Sequence[Face]]:
    return _BOX * size, _BOX_FACES


def _circle(radius: float, count: int) -> Float64:
    """Return points [count, 2] on a circle around the origin, counter-clockwise."""
    turn = np.arange(count) * (2 * math.pi / count)
    return np.column_stack([np.cos(turn), np.sin(turn)]) * radius


def _belt(start: int, count: int) -> list[Face]:
    """Return the faces between the ring of vertices at `start` and the ring after it, `count` vertices each."""
    around = [(start + i, start + (i + 1) % count) for i in range(count)]
    return [(a, b, b + count, a + count) for a, b in around]


def _cylinder(radius: float, length: float) -> tuple[Float64, Sequence[Face]]:
    count = _MANY_SIDES if length >= _LONG else _SIDES
    rim = _circle(radius, count)
    low, high = (np.column_stack([rim, np.full(count, z)]) for z in (-length / 2, length / 2))
    ends = tuple(reversed(range(count))), tuple(range(count, 2 * count))
    return np.concatenate([low, high]), [*_belt(0, count), *ends]


def _sphere(radius: float) -> tuple[Float64, Sequence[Face]]:
    height = np.linspace(-math.pi / 2, math.pi / 2, _RINGS + 1)
    rings = [
        np.column_stack([_circle(math.cos(h), _SIDES), np.full(_SIDES, math.sin(h))]) for h in height[1:-1]
    ]
    vertices = np.concatenate([*rings, [[0, 0, -1], [0, 0, 1]]]) * radius
    south, north = len(vertices) - 2, len(vertices) - 1
    last = (_RINGS - 2) * _SIDES
    belts = [face for start in range(0, last, _SIDES) for face in _belt(start, _SIDES)]
    caps = [face for a, b, *_ in _belt(0, _SIDES) for face in ((b, a, south), (a + last, b + last, north))]
    return vertices, [*belts, *caps]


_SHAPES: dict[str, Callable[..., tuple[Float64, Sequence[Face]]]] = {
    "box": _box,
    "cylinder": _cylinder,
    "sphere": _sphere,
}


def _normal(corners: Float64) -> Float64:
    """Return the unit normal of a flat face [n, 3] with counter-clockwise corners."""
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[1])
    return np.asarray(normal / np.linalg.norm(normal))
