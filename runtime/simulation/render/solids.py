"""Convex solids as vertices and flat faces: boxes, cylinders, spheres, each fixed in a moving frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from runtime.core.types import Float32, Float64

Face = tuple[int, ...]
_SIDES = 16  # of a short cylinder, and of a sphere
_MANY_SIDES, _LONG = 24, 0.05  # sides of cylinders of this length [m] or more
_RINGS = 6  # bands of a sphere, from pole to pole
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
    """Box (x, y, z), cylinder (radius, length along z) or sphere (radius,) in metres, fixed in frame `frame`.

    `origin` [4, 4] is the pose of its centre in that frame; `colour` is red, green, blue, 0 to 1. A `painted` solid is
    matt and has lighter edges; other solids have a lacquered finish.
    """

    frame: int
    kind: str
    size: tuple[float, ...]
    origin: Float64
    colour: tuple[float, float, float]
    painted: bool = False


class Solids:
    """Solids in flat arrays: V vertices, F faces (corners counter-clockwise seen from outside), S solids."""

    def __init__(self, solids: Sequence[Solid]) -> None:
        meshes = [_mesh(solid) for solid in solids]
        counts = [len(vertices) for vertices, _ in meshes]
        self.starts = np.cumsum([0, *counts[:-1]])  # [S] first vertex of each solid
        self.stops = self.starts + counts
        self.solids = tuple(solids)
        self.frames = np.array([solid.frame for solid in solids], np.intp)
        self._vertices = np.concatenate(
            [
                vertices @ solid.origin[:3, :3].T + solid.origin[:3, 3]
                for (vertices, _), solid in _pairs(meshes, solids)
            ]
        ).astype(np.float32)[..., None]
        self._vertex_frames = np.repeat(self.frames, counts)
        self.faces = [
            np.add(face, start, dtype=np.intp)
            for (_, faces), start in zip(meshes, self.starts, strict=True)
            for face in faces
        ]
        self.face_solids = np.repeat(np.arange(len(solids)), [len(faces) for _, faces in meshes])
        self.face_counts = np.bincount(self.face_solids)
        self.face_starts = np.cumsum(self.face_counts) - self.face_counts
        self.faces_of = [
            range(start, start + count)
            for start, count in zip(self.face_starts.tolist(), self.face_counts.tolist(), strict=True)
        ]
        self.face_corner = np.array([face[0] for face in self.faces])
        self._normals = np.array([_normal(self._vertices[face, :, 0]) for face in self.faces], np.float32)[
            ..., None
        ]
        self._face_frames = self.frames[self.face_solids]
        self.face_colours = np.array([solid.colour for solid in solids], np.float32)[self.face_solids]
        self.face_matt = np.array([solid.painted for solid in solids])[self.face_solids]
        self._origins = np.array([solid.origin for solid in solids], np.float32)
        self.halves = np.array(
            [_half(solid) for solid in solids], np.float32
        )  # [S, 3] of the box around each

    def placed(self, frames: Float64) -> Placed:
        """Return the solids in the world for the poses of all frames, world <- frame [N, 4, 4]."""
        near = frames.astype(np.float32)
        turns, shifts = near[:, :3, :3], near[:, :3, 3]
        vertices = (turns[self._vertex_frames] @ self._vertices)[..., 0] + shifts[self._vertex_frames]
        normals = (turns[self._face_frames] @ self._normals)[..., 0]
        boxes = near[self.frames] @ self._origins
        visible = np.ones(len(self.solids), bool)
        return Placed(vertices, normals, boxes[:, :3, 3], boxes[:, :3, :3].transpose(0, 2, 1), visible)

    def above_table(self, placed: Placed) -> Placed:
        """Return the solids with everything below the table, z = 0, cut off; those entirely below it are not drawn."""
        above = np.maximum.reduceat(placed.vertices[:, 2], self.starts) > 0
        cut = placed.vertices.copy()
        np.maximum(cut[:, 2], 0, out=cut[:, 2])
        return replace(placed, vertices=cut, seen=above)


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Solids in the world: vertices [V, 3], outward normals [F, 3], and the boxes around the solids.

    A box has its centre [S, 3] and its three unit axes as the rows of [S, 3, 3]. `seen` [S] is False for solids that
    are not drawn.
    """

    vertices: Float32
    normals: Float32
    centres: Float32
    axes: Float32
    seen: NDArray[np.bool_]


def _pairs(
    meshes: Sequence[tuple[Float64, Sequence[Face]]], solids: Sequence[Solid]
) -> list[tuple[tuple[Float64, Sequence[Face]], Solid]]:
    return list(zip(meshes, solids, strict=True))


def _mesh(solid: Solid) -> tuple[Float64, Sequence[Face]]:
    """Return the vertices [n, 3] of a solid relative to its centre, and its faces."""
    if solid.kind == "box":
        return _BOX * solid.size, _BOX_FACES
    if solid.kind == "cylinder":
        return _cylinder(*solid.size)
    return _sphere(*solid.size)


def _half(solid: Solid) -> tuple[float, float, float]:
    if solid.kind == "box":
        x, y, z = solid.size
        return x / 2, y / 2, z / 2
    radius = solid.size[0]
    return radius, radius, solid.size[1] / 2 if solid.kind == "cylinder" else radius


def circle(radius: float, count: int) -> Float64:
    """Return points [count, 2] on a circle around the origin, counter-clockwise."""
    turn = np.arange(count) * (2 * math.pi / count)
    return np.column_stack([np.cos(turn), np.sin(turn)]) * radius


def _cylinder(radius: float, length: float) -> tuple[Float64, Sequence[Face]]:
    count = _MANY_SIDES if length >= _LONG else _SIDES
    rim = circle(radius, count)
    low, high = (np.column_stack([rim, np.full(count, z)]) for z in (-length / 2, length / 2))
    ring = range(count)
    sides = [(i, (i + 1) % count, (i + 1) % count + count, i + count) for i in ring]
    return np.concatenate([low, high]), [*sides, tuple(reversed(ring)), tuple(i + count for i in ring)]


def _sphere(radius: float) -> tuple[Float64, Sequence[Face]]:
    height = np.linspace(-math.pi / 2, math.pi / 2, _RINGS + 1)
    rings = [
        np.column_stack([circle(math.cos(h), _SIDES), np.full(_SIDES, math.sin(h))]) for h in height[1:-1]
    ]
    vertices = np.concatenate([*rings, [[0, 0, -1], [0, 0, 1]]]) * radius
    south, north = len(vertices) - 2, len(vertices) - 1
    around = [(i, (i + 1) % _SIDES) for i in range(_SIDES)]
    last = (_RINGS - 2) * _SIDES
    belts = [
        (a + s, b + s, b + s + _SIDES, a + s + _SIDES) for s in range(0, last, _SIDES) for a, b in around
    ]
    caps = [face for a, b in around for face in ((b, a, south), (a + last, b + last, north))]
    return vertices, [*belts, *caps]


def _normal(corners: NDArray[np.float32]) -> Float64:
    """Return the unit normal of a flat face [n, 3] with counter-clockwise corners."""
    corners = corners.astype(np.float64)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[1])
    return np.asarray(normal / np.linalg.norm(normal))
