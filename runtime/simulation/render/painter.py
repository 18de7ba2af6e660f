"""Painter of solids into a camera's image, from back to front, with smooth edges and light from one side."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.core.types import Float32, UInt8
from runtime.simulation.bench.bench import PinholeCamera
from runtime.simulation.render.order import Order, painted
from runtime.simulation.render.solids import Placed, Solids

LIGHT = np.array([-0.36, 0.28, 0.89], np.float32)  # direction towards the lamp
LIGHT /= np.linalg.norm(LIGHT)
_FILL = np.array([0.75, -0.6, 0.25], np.float32)  # direction towards a second, weak lamp
_FILL /= np.linalg.norm(_FILL)
_NEAR = 0.012  # [m] in front of the camera; nothing nearer is drawn
_SHIFT = 4  # fractional bits of pixel coordinates
_FAR_OUT = 12000.0  # [pixels]; OpenCV's coordinates end at 32767
_OUTLINE = 0.62  # brightness of a solid's outline relative to its faces
_GLOSS, _SHINE = 0.14, 20  # strength and exponent of highlights


class Painter:
    """Painter of `solids` at one moment; create it once per moment and call `paint` for every camera."""

    def __init__(self, solids: Solids, placed: Placed) -> None:
        self._solids = solids
        self._placed = placed
        self._corners = placed.vertices[solids.face_corner]
        normals = placed.normals
        lit = 0.50 + 0.10 * normals[:, 2] + 0.40 * np.maximum(normals @ LIGHT, 0)
        lit += 0.16 * np.maximum(normals @ _FILL, 0)
        self._colours = solids.face_colours * (255 * lit[:, None])  # [F, 3] RGB
        total = np.add.reduceat(self._colours, solids.face_starts)
        rims = total / solids.face_counts[:, None] * _OUTLINE
        self._rims: list[list[float]] = rims[:, ::-1].tolist()

    def paint(self, picture: UInt8, camera: PinholeCamera) -> None:
        """Draw all solids in the camera's view onto the image."""
        solids, placed = self._solids, self._placed
        eye = camera.pose[:3, 3].astype(np.float32)
        inside = (placed.vertices - eye) @ camera.pose[:3, :3].astype(np.float32)
        chosen = np.flatnonzero(_in_view(camera, inside, solids) & placed.seen)
        if not len(chosen):
            return
        near = np.minimum.reduceat(inside[:, 2], solids.starts) < _NEAR
        pixels = _pixels(camera, inside)
        low = np.minimum.reduceat(pixels, solids.starts)
        high = np.maximum.reduceat(pixels, solids.starts)
        low[near], high[near] = -_FAR_OUT, _FAR_OUT
        overlap = _overlap(low[chosen], high[chosen])
        hides = Order(placed.axes[chosen], placed.centres[chosen], solids.halves[chosen]).hides(eye)
        distance = np.linalg.norm(placed.centres[chosen] - eye, axis=1)
        facing = self._facing(eye, chosen)
        corners = (pixels * (1 << _SHIFT)).round().astype(np.int32)
        for place in painted(hides, overlap, distance):
            solid = int(chosen[place])
            if near[solid]:
                self._paint_near(picture, camera, inside, solid, facing)
            else:
                self._paint_solid(picture, corners, solid, facing)

    def _facing(self, eye: Float32, chosen: NDArray[np.intp]) -> dict[int, tuple[float, ...]]:
        """Return the visible faces of the chosen solids with their colours (blue, green, red).

        A face is visible if `eye` is on its outer side.
        """
        solids, normals = self._solids, self._placed.normals
        is_chosen = np.zeros(len(solids.solids), bool)
        is_chosen[chosen] = True
        faces = np.flatnonzero(is_chosen[solids.face_solids])
        ray = eye - self._corners[faces]
        outside = np.einsum("fd,fd->f", ray, normals[faces]) > 0
        faces, ray = faces[outside], ray[outside]
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        half = ray + LIGHT
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        gloss = np.maximum(np.einsum("fd,fd->f", half, normals[faces]), 0) ** _SHINE
        gloss[solids.face_matt[faces]] = 0
        colours = np.minimum(self._colours[faces] + (255 * _GLOSS) * gloss[:, None], 255)
        return dict(zip(faces.tolist(), map(tuple, colours[:, ::-1].tolist()), strict=True))

    def _paint_solid(
        self,
        picture: UInt8,
        corners: NDArray[np.int32],
        solid: int,
        facing: Mapping[int, tuple[float, ...]],
    ) -> None:
        solids = self._solids
        faces = [face for face in solids.faces_of[solid] if face in facing]
        hull = cv2.convexHull(corners[solids.starts[solid] : solids.stops[solid]])
        cv2.fillConvexPoly(picture, hull, self._rims[solid], cv2.LINE_AA, _SHIFT)
        for face in faces:
            cv2.fillConvexPoly(picture, corners[solids.faces[face]], facing[face], cv2.LINE_AA, _SHIFT)
        if solids.solids[solid].painted:
            for face in faces:
                edge = [min(255.0, 1.18 * part + 12) for part in facing[face]]
                cv2.polylines(picture, [corners[solids.faces[face]]], True, edge, 1, cv2.LINE_AA, _SHIFT)

    def _paint_near(
        self,
        picture: UInt8,
        camera: PinholeCamera,
        inside: Float32,
        solid: int,
        facing: Mapping[int, tuple[float, ...]],
    ) -> None:
        """Paint a solid that extends behind the camera: only the parts of its faces that are in front of the camera."""
        for face in self._solids.faces_of[solid]:
            if face in facing:
                fill_ahead(picture, camera, inside[self._solids.faces[face]], facing[face])


def fill_ahead(
    picture: UInt8,
    camera: PinholeCamera,
    inside: Float32,
    colour: tuple[float, ...] | list[float],
    edges: int = cv2.LINE_AA,
) -> None:
    """Fill the part of a flat polygon [n, 3] in camera axes that is in front of the camera."""
    corners = ahead(inside)
    if len(corners) < 3:
        return
    pixels = _pixels(camera, corners)
    if (pixels.max(0) > -1).all() and (pixels.min(0) < (camera.width, camera.height)).all():
        fixed = (pixels * (1 << _SHIFT)).round().astype(np.int32)
        cv2.fillConvexPoly(picture, fixed, colour, edges, _SHIFT)


def ahead(inside: Float32) -> Float32:
    """Return the part [m, 3] of a flat polygon [n, 3] in camera axes that is in front of the camera, or [0, 3]."""
    clipped: list[list[float]] = []
    corners: list[list[float]] = inside.tolist()
    before = corners[-1]
    for corner in corners:
        if (corner[2] >= _NEAR) != (before[2] >= _NEAR):
            share = (_NEAR - before[2]) / (corner[2] - before[2])
            clipped.append([a + (b - a) * share for a, b in zip(before, corner, strict=True)])
        if corner[2] >= _NEAR:
            clipped.append(corner)
        before = corner
    return np.array(clipped, np.float32).reshape(-1, 3)


def _in_view(camera: PinholeCamera, inside: Float32, solids: Solids) -> NDArray[np.bool_]:
    """Return bool [S]: False for solids that are entirely behind the camera or beyond one side of its image."""
    x, y, depth = inside.T
    across, down = x * camera.fx, y * camera.fy
    sides = (
        depth - _NEAR,
        across + (camera.cx + 1) * depth,
        (camera.width - camera.cx) * depth - across,
        down + (camera.cy + 1) * depth,
        (camera.height - camera.cy) * depth - down,
    )
    return np.asarray((np.maximum.reduceat(np.array(sides), solids.starts, axis=1) > 0).all(0))


def _pixels(camera: PinholeCamera, inside: Float32) -> Float32:
    """Project the points `inside` [n, 3], given in camera axes, and return their pixels [n, 2] as columns and rows."""
    depth = np.maximum(inside[:, 2:], _NEAR)
    pixels = inside[:, :2] / depth * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return np.asarray(np.clip(pixels, -_FAR_OUT, _FAR_OUT), np.float32)


def _overlap(low: Float32, high: Float32) -> NDArray[np.bool_]:
    """Return bool [S, S]: whether two rectangles, given by their corners, intersect or touch."""
    return np.asarray(((low[:, None] <= high + 1) & (low <= high[:, None] + 1)).all(-1))
