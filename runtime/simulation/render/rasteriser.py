"""Compiled rasteriser: convex flat faces in a camera's image, hidden surfaces removed at every sample of every pixel.

A face is the set of rays between its edges. Each edge is a plane through the eye, and on a row of samples these planes
bound an interval, so that faces that extend behind the camera need no clipping. Along a row, the reciprocal of the
depth is linear. Results depend on nothing but the arguments: there is one thread, and floating-point operations are
exactly those written here.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from runtime.core.types import Float32, Float64, UInt8
from runtime.kinematics.kernels.compilation import exact_function, exact_kernel

Index = NDArray[np.int64]
Int32 = NDArray[np.int32]
UInt32 = NDArray[np.uint32]
Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]


def _unit(x: float, y: float, z: float) -> Vector:
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


LACQUER, PAINT, SHADED, GROUND, _BACKGROUND = range(5)
"""Finishes of faces: glossy; matt with lighter edges; colour or texture of the table, with the shadows on the table."""
LIGHT = _unit(-0.36, 0.28, 0.89)  # direction towards the lamp
_FILL = _unit(0.75, -0.6, 0.25)  # direction towards a second, weak lamp
_GLOSS, _SHINE = 0.14, 20  # strength and exponent of highlights
_NEAR = 0.012  # [m] in front of the camera; nothing nearer is drawn
_ROWS, _FEW_ROWS, _COLUMNS = 4, 2, 2  # samples of a pixel in small and in large images
_LARGE = 400  # [pixels] width from which an image is large: steps along edges are small there
_OFFSETS = (0.125, 0.625, 0.375, 0.875)  # first sample of each row, in distances between samples
_EDGE = 1.0  # [pixels] width of lighter edges
_ONE = np.uint64(1)  # with numbers that are not negative, array elements need no check of the sign
_FLAT = 1e-12  # least inclination of an edge to the rows
_SOFT_FROM = 0.09  # [m] height above the table from which shadows are soft
_ROOM = ((-2.4, 2.4), (-2.4, 2.4), (-0.75, 1.9))  # [m] bounds of the room in x, y, z
_SKIRTING = -0.05  # [m] height below which walls are darker
_WALLS = ((194.0, 190.0), (178.0, 204.0))  # brightness at low and high x, at low and high y


class Geometry(NamedTuple):
    """S solids with V vertices and F convex flat faces, each solid in a frame of its own.

    `starts` [S + 1] has the first vertex of each solid, `face_starts` [F + 1] the first of each face's `corners`, which
    are counter-clockwise seen from outside. `colours` [F, 3] are blue, green, red, 0 to 255.
    """

    vertices: Float64
    starts: Index
    frames: Index
    face_starts: Index
    corners: Index
    face_solids: Index
    normals: Float64
    colours: Float64
    finishes: Index


class View(NamedTuple):
    """Camera at `eye` [3] whose colours are multiplied by `gain`.

    `lens` [3, 3] leads from a point relative to the eye, in the axes of the world, to its homogeneous image point,
    whose third number is the depth [m]; `rays` is its inverse.
    """

    eye: Vector
    lens: Matrix
    rays: Matrix
    gain: float


class Ground(NamedTuple):
    """Corner (x, y) of the table [m], and points per metre of its texture and of the map of its light."""

    x: float
    y: float
    scale: float
    light_scale: float


class Scratch(NamedTuple):
    """Buffers of drawing for F faces with C corners, in images [H, W]; what they contain between calls has no effect.

    * `rows` [H]: first of the faces whose first row this is, -1 if there is none.
    * `faces` [F, 5], of faces that may be visible: next face with the same first row or -1, last row, start and stop of
      its lines, number of its paint.
    * `depths` [F, 3], of the same faces: change of the reciprocal of the depth per column and per row, and its value at
      column and row 0.
    * `points` and `lines` [C + F, 3]: corners and edges of the same faces.
    * `paints` [2 F + 1, 3] and `finishes` [2 F + 1]: first that of the room; after the paint of a face with finish
      PAINT, that of its edges.
    * `active` [F]: faces on the present row of pixels.
    * `nearest` and `owners` [n, m]: for each sample of this row, reciprocal of the least depth, and the paint.
    * `uniform` [W]: the paint of each pixel of this row, -1 if its samples have several.
    * `places`, `parts`, `texels`, `lights` [4, W], `brightness` [W], `table` [3, W]: what the pixels of this row would
      show of an empty table.
    """

    rows: Index
    faces: Index
    depths: Float64
    points: Float64
    lines: Float64
    paints: Float64
    finishes: Index
    active: Index
    nearest: Float32
    owners: Int32
    uniform: Int32
    places: Int32
    parts: Float32
    texels: UInt32
    lights: UInt8
    brightness: Float32
    table: UInt8


def make_scratch(geometry: Geometry, width: int, height: int) -> Scratch:
    """Return buffers for a geometry, and for images [height, width]."""
    faces, corners = len(geometry.normals), len(geometry.corners)
    rows = _FEW_ROWS if width >= _LARGE else _ROWS
    return Scratch(
        rows=np.empty(height, np.int64),
        faces=np.empty((faces, 5), np.int64),
        depths=np.empty((faces, 3)),
        points=np.empty((corners + faces, 3)),
        lines=np.empty((corners + faces, 3)),
        paints=np.empty((2 * faces + 1, 3)),
        finishes=np.empty(2 * faces + 1, np.int64),
        active=np.empty(faces, np.int64),
        nearest=np.empty((rows, width * _COLUMNS), np.float32),
        owners=np.empty((rows, width * _COLUMNS), np.int32),
        uniform=np.empty(width, np.int32),
        places=np.empty((4, width), np.int32),
        parts=np.empty((4, width), np.float32),
        texels=np.empty((4, width), np.uint32),
        lights=np.empty((4, width), np.uint8),
        brightness=np.empty(width, np.float32),
        table=np.empty((3, width), np.uint8),
    )


@exact_kernel
def place(geometry: Geometry, poses: Float64, vertices: Float64, normals: Float64) -> None:
    """Write vertices [V, 3] and normals [F, 3] in the world, for the poses of all frames, world <- frame [N, 4, 4]."""
    for solid in range(len(geometry.frames)):
        frame = geometry.frames[solid]
        for vertex in range(geometry.starts[solid], geometry.starts[solid + 1]):
            for i in range(3):
                vertices[vertex, i] = _turned(poses, frame, i, geometry.vertices, vertex) + poses[frame, i, 3]
    for face in range(len(normals)):
        frame = geometry.frames[geometry.face_solids[face]]
        for i in range(3):
            normals[face, i] = _turned(poses, frame, i, geometry.normals, face)


@exact_function
def _turned(poses: Float64, frame: int, i: int, vectors: Float64, row: int) -> float:
    x, y, z = poses[frame, i, 0], poses[frame, i, 1], poses[frame, i, 2]
    return float(x * vectors[row, 0] + y * vectors[row, 1] + z * vectors[row, 2])


@exact_kernel
def cast(
    geometry: Geometry,
    vertices: Float64,
    normals: Float64,
    discs: Float64,
    corner: Vector,
    scratch: Scratch,
    soft: UInt8,
    sharp: UInt8,
) -> None:
    """Darken the maps [m, n] of soft and sharp shadows by the shadows of all solids that light reaches.

    A solid above a disc casts its shadow on the disc; `discs` [n, 4] are x, y, radius and height [m]. `corner` is the
    place x, y of the maps' first point, and the distance between points [m].
    """
    height, width = soft.shape
    points, lines = scratch.points, scratch.lines
    solid, level, floor, middle = -1, 0, 0.0, 0.0
    for face in range(len(normals)):
        if geometry.finishes[face] > PAINT or _dot(normals, face, LIGHT) <= 0:
            continue
        if geometry.face_solids[face] != solid:
            solid = geometry.face_solids[face]
            first, last = geometry.starts[solid], geometry.starts[solid + 1]
            x, y, middle = _middle(vertices, first, last)
            level = int(150 + 60 * min(1.0, middle / 0.4)) if middle > _SOFT_FROM else 118
            floor = _floor(x, y, discs)
        start, stop = geometry.face_starts[face], geometry.face_starts[face + 1]
        low, high, top = float(height), -1.0, 0.0
        for k in range(start, stop):
            vertex = geometry.corners[start + stop - 1 - k]  # rows go down in images, but towards y here
            above = max(vertices[vertex, 2] - floor, 0.0)
            top = max(top, vertices[vertex, 2])
            points[k, 0] = (vertices[vertex, 0] - above * (LIGHT[0] / LIGHT[2]) - corner[0]) / corner[2]
            points[k, 1] = (vertices[vertex, 1] - above * (LIGHT[1] / LIGHT[2]) - corner[1]) / corner[2]
            points[k, 2] = 1.0
            low, high = min(low, points[k, 1]), max(high, points[k, 1])
        if top <= 0:
            continue
        _outline(points, start, stop, lines)
        for row in range(max(0, math.ceil(low)), min(height - 1, math.floor(high)) + 1):
            left, right = _span(lines, start, stop, float(row), 0.0)
            for column in range(math.ceil(max(0.0, left)), math.floor(min(width - 1.0, right)) + 1):
                if middle > _SOFT_FROM:
                    soft[row, column] = min(soft[row, column], level)
                else:
                    sharp[row, column] = min(sharp[row, column], level)


@exact_function
def _middle(vertices: Float64, first: int, last: int) -> Vector:
    x = y = z = 0.0
    for vertex in range(first, last):
        x, y, z = x + vertices[vertex, 0], y + vertices[vertex, 1], z + vertices[vertex, 2]
    return x / (last - first), y / (last - first), z / (last - first)


@exact_function
def _floor(x: float, y: float, discs: Float64) -> float:
    """Return the height on which the shadow of a solid at (x, y) falls [m]."""
    floor = 0.0
    for disc in range(len(discs)):
        if math.hypot(x - discs[disc, 0], y - discs[disc, 1]) < 0.9 * discs[disc, 2]:
            floor = 0.4 * discs[disc, 3]
    return floor


@exact_function
def _dot(vectors: Float64, row: int, other: Vector) -> float:
    return float(vectors[row, 0] * other[0] + vectors[row, 1] * other[1] + vectors[row, 2] * other[2])


@exact_function
def _outline(points: Float64, start: int, stop: int, lines: Float64) -> None:
    """Write the edges of a face to lines[start:stop].

    Its corners are the homogeneous image points points[start:stop], counter-clockwise if all are in front of the eye.
    """
    for k in range(start, stop):
        following = k + 1 if k + 1 < stop else start
        a = points[following, 0], points[following, 1], points[following, 2]
        b = points[k, 0], points[k, 1], points[k, 2]
        across, down = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2]
        _half_plane(across, down, a[0] * b[1] - a[1] * b[0], lines[k])


@exact_function
def _half_plane(across: float, down: float, constant: float, line: Float64) -> None:
    """Write the bound of the half plane in which across * u + down * v + constant >= 0, for columns u and rows v.

    On row v it is at column line[0] * v + line[1]. The third number is positive if the half plane is to the right; its
    size is the length along a row of a stripe of width 1 along the bound. A bound at infinity bounds nothing.
    """
    if abs(across) < _FLAT * abs(down):
        across = math.copysign(_FLAT * down, across)
    if across == 0:
        line[0], line[1], line[2] = 0.0, -1e9, 1.0
    else:
        line[0], line[1] = -down / across, -constant / across
        line[2] = math.copysign(math.sqrt(1 + line[0] * line[0]), across)


@exact_function
def _span(lines: Float64, start: int, stop: int, v: float, inset: float) -> tuple[float, float]:
    """Return the columns between which a face is on image row `v`, without a margin of `inset` along its edges."""
    left, right = -1e9, 1e9
    for k in range(start, stop):
        column = lines[k, 0] * v + lines[k, 1] + inset * lines[k, 2]
        if lines[k, 2] > 0:
            left = max(left, column)
        else:
            right = min(right, column)
    return left, right


@exact_kernel
def draw(
    geometry: Geometry,
    vertices: Float64,
    normals: Float64,
    view: View,
    ground: Ground,
    texture: UInt32,
    light: UInt8,
    scratch: Scratch,
    picture: UInt8,
) -> None:
    """Draw room, table and solids into `picture` BGR [H, W, 3], for the world's vertices [V, 3] and normals [F, 3].

    `texture` [h, w] and `light` [m, n] (255 = full light) show the table from its corner on. The bits of a texture's
    points are, from the highest, 8 unused, 8 of red, 8 of green and 8 of blue.
    """
    faces, active, count = scratch.faces, scratch.active, 0
    _find_visible_faces(geometry, vertices, normals, view, picture, scratch)
    for row in range(picture.shape[0]):
        scratch.nearest[:] = 0
        scratch.owners[:] = 0
        face = scratch.rows[row]
        while face >= 0:
            active[count] = face
            count, face = count + 1, faces[face, 0]
        remaining = 0
        for i in range(count):
            face = active[i]
            _scan(row, face, scratch)
            if faces[face, 1] > row:
                active[remaining] = face
                remaining += 1
        count = remaining
        _resolve(row, scratch, view, ground, texture, light, picture)


@exact_function
def _find_visible_faces(
    geometry: Geometry, vertices: Float64, normals: Float64, view: View, picture: UInt8, scratch: Scratch
) -> None:
    """Write the faces that may be visible, with their lines and paints."""
    faces, depths, lines, paints, finishes = (
        scratch.faces,
        scratch.depths,
        scratch.lines,
        scratch.paints,
        scratch.finishes,
    )
    scratch.rows[:] = -1
    finishes[0] = _BACKGROUND
    count, stop, paint = 0, 0, 1
    for face in range(len(normals)):
        corners = geometry.corners[geometry.face_starts[face] : geometry.face_starts[face + 1]]
        ray = _ray(vertices, corners[0], view.eye)
        distance = _dot(normals, face, ray)
        if not distance > 0:  # a face without an area has no normal
            continue
        start, stop_ahead = stop, stop + len(corners)
        first, last, closest = _project(corners, vertices, view, picture, scratch.points[start:stop_ahead])
        if first > last:
            continue
        _outline(scratch.points, start, stop_ahead, lines)
        for i in range(3):
            axis = view.rays[0][i], view.rays[1][i], view.rays[2][i]
            depths[count, i] = -_dot(normals, face, axis) / distance
        stop = stop_ahead
        if closest < _NEAR:
            _half_plane(-depths[count, 0], -depths[count, 1], 1 / _NEAR - depths[count, 2], lines[stop])
            stop += 1
        faces[count, 0], scratch.rows[first] = scratch.rows[first], count
        faces[count, 1], faces[count, 2], faces[count, 3], faces[count, 4] = last, start, stop, paint
        count += 1
        finish = geometry.finishes[face]
        finishes[paint] = finish
        for i in range(3):
            paints[paint, i] = geometry.colours[face, i]
        if finish <= PAINT:
            _light(paints[paint], finish == LACQUER, normals, face, ray)
        if finish == PAINT:
            finishes[paint + 1] = finish
        for i in range(3):
            if finish == PAINT:
                paints[paint + 1, i] = view.gain * min(255.0, 1.18 * paints[paint, i] + 12)
            paints[paint, i] *= view.gain
        paint += 2 if finish == PAINT else 1


@exact_function
def _ray(vertices: Float64, vertex: int, eye: Vector) -> Vector:
    """Return the vector from a vertex to the eye."""
    return eye[0] - vertices[vertex, 0], eye[1] - vertices[vertex, 1], eye[2] - vertices[vertex, 2]


@exact_function
def _project(
    corners: Index, vertices: Float64, view: View, picture: UInt8, points: Float64
) -> tuple[int, int, float]:
    """Write homogeneous image points [n, 3] of corners; return first and last row of their face and the least depth.

    The first row is below the last if the face is not in the image.
    """
    height, width, closest = picture.shape[0], picture.shape[1], 1e9
    for k in range(len(corners)):
        x, y, z = _ray(vertices, corners[k], view.eye)
        for i in range(3):
            points[k, i] = -view.lens[i][0] * x - view.lens[i][1] * y - view.lens[i][2] * z
        closest = min(closest, points[k, 2])
    left, right, top, bottom = 1e9, -1e9, 1e9, -1e9
    for k in range(len(corners)):
        depth, before = points[k, 2], points[k - 1, 2]
        if depth >= _NEAR:
            u, v = points[k, 0] / depth, points[k, 1] / depth
            left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
        if (depth >= _NEAR) != (before >= _NEAR):
            share = (_NEAR - before) / (depth - before)
            u = (points[k - 1, 0] + share * (points[k, 0] - points[k - 1, 0])) / _NEAR
            v = (points[k - 1, 1] + share * (points[k, 1] - points[k - 1, 1])) / _NEAR
            left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
    if right < -0.5 or left > width - 0.5 or bottom < top:
        return 1, 0, closest
    return max(0, math.floor(top + 0.5)), min(height - 1, math.floor(bottom + 0.5)), closest


@exact_function
def _light(paint: Float64, is_glossy: bool, normals: Float64, face: int, ray: Vector) -> None:
    """Light a face's colour [3] as seen along `ray`, which points to the eye."""
    lamp, fill = _dot(normals, face, LIGHT), _dot(normals, face, _FILL)
    brightness = 0.50 + 0.10 * normals[face, 2] + 0.40 * max(lamp, 0.0) + 0.16 * max(fill, 0.0)
    gloss = 0.0
    if is_glossy:
        length = math.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2])
        half = (ray[0] / length + LIGHT[0], ray[1] / length + LIGHT[1], ray[2] / length + LIGHT[2])
        length = math.sqrt(half[0] * half[0] + half[1] * half[1] + half[2] * half[2])
        cosine = max(_dot(normals, face, half) / length, 0.0)
        gloss = 255 * _GLOSS * cosine**_SHINE
    for i in range(3):
        paint[i] = min(paint[i] * brightness + gloss, 255.0)


@exact_function
def _scan(row: int, face: int, scratch: Scratch) -> None:
    """Note a face at all samples of a row of pixels at which nothing is nearer."""
    faces, depths, lines, nearest, owners = (
        scratch.faces,
        scratch.depths,
        scratch.lines,
        scratch.nearest,
        scratch.owners,
    )
    start, stop, paint = faces[face, 2], faces[face, 3], faces[face, 4]
    size, step = nearest.shape[1], depths[face, 0] / _COLUMNS
    rows = nearest.shape[0]
    for k in range(rows):
        v = row - 0.5 + (k + 0.5) / rows
        base = depths[face, 1] * v + depths[face, 2] + depths[face, 0] * (_OFFSETS[k] / _COLUMNS - 0.5)
        left, right = _span(lines, start, stop, v, 0.0)
        first, last = _column(left, k, size), _column(right, k, size)
        if scratch.finishes[paint] != PAINT:
            _fill(nearest, owners, k, first, last, base, step, paint)
        elif first < last:
            left, right = _span(lines, start, stop, v, _EDGE)
            inner = min(_column(left, k, size), last)
            outer = max(_column(right, k, size), inner)
            _fill(nearest, owners, k, first, inner, base, step, paint + 1)
            _fill(nearest, owners, k, inner, outer, base, step, paint)
            _fill(nearest, owners, k, outer, last, base, step, paint + 1)


@exact_function
def _column(u: float, k: int, size: int) -> int:
    """Return the number of the first sample of a pixel's row `k` of samples that is not left of column `u`."""
    return math.ceil(min(max(0.0, (u + 0.5) * _COLUMNS - _OFFSETS[k]), float(size)))


@exact_function
def _fill(
    nearest: Float32,
    owners: Int32,
    k: int,
    first: int,
    last: int,
    base: float,
    step: float,
    paint: int,
) -> None:
    """Note a paint at the samples [first, last) of row `k` at which nothing is nearer; unsigned numbers are faster."""
    line, number, here, slope = np.uint64(k), np.int32(paint), np.float32(base), np.float32(step)
    for sample in range(np.uint64(first), np.uint64(max(first, last))):
        depth = here + slope * np.float32(np.int32(sample))
        if depth > nearest[line, sample]:
            nearest[line, sample] = depth
            owners[line, sample] = number


@exact_function
def _resolve(
    row: int,
    scratch: Scratch,
    view: View,
    ground: Ground,
    texture: UInt32,
    light: UInt8,
    picture: UInt8,
) -> None:
    """Write a row of pixels, each the mean of its samples."""
    owners = scratch.owners
    _find_places(row, view, ground, texture, light, scratch.places, scratch.parts)
    _read_points(scratch.places, texture, light, scratch.texels, scratch.lights)
    _blend(scratch.parts, scratch.texels, scratch.lights, view.gain, scratch.brightness, scratch.table)
    _compare(owners, scratch.uniform)
    column, width = np.uint64(0), np.uint64(picture.shape[1])
    while column < width:
        paint, last = scratch.uniform[column], column + _ONE
        while paint >= 0 and last < width and scratch.uniform[last] == paint:
            last += _ONE
        if paint >= 0 and scratch.finishes[paint] == GROUND:
            for c in range(column, last):
                for i in range(3):
                    picture[row, c, i] = scratch.table[i, c]
        elif paint >= 0 and scratch.finishes[paint] <= PAINT:
            blue, green, red = _shade(paint, row, column, scratch, view)
            b, g, r = _level(blue), _level(green), _level(red)
            for c in range(column, last):
                picture[row, c, 0], picture[row, c, 1], picture[row, c, 2] = b, g, r
        else:
            for c in range(column, last):
                blue, green, red = _mean(row, c, scratch, view)
                picture[row, c, 0], picture[row, c, 1] = _level(blue), _level(green)
                picture[row, c, 2] = _level(red)
        column = last


@exact_function
def _level(value: float) -> np.uint8:
    return np.uint8(min(value + 0.5, 255.0))


@exact_function
def _compare(owners: Int32, uniform: Int32) -> None:
    """Write the paint of each pixel of a row, -1 if its samples have several; several pixels at once."""
    columns, width = np.uint64(_COLUMNS), np.uint64(len(uniform))
    for column in range(width):
        uniform[column] = owners[0, columns * column]
    for k in range(np.uint64(owners.shape[0])):
        for i in range(columns):
            for column in range(width):
                paint = uniform[column]
                uniform[column] = paint if owners[k, columns * column + i] == paint else np.int32(-1)


@exact_function
def _mean(row: int, column: int, scratch: Scratch, view: View) -> Vector:
    """Return the mean colour of a pixel's samples."""
    owners, first, paint = scratch.owners, column * np.uint64(_COLUMNS), -1
    rows = owners.shape[0]
    weight = 1 / (rows * _COLUMNS)
    blue = green = red = b = g = r = 0.0
    for k in range(rows):
        for i in range(np.uint64(_COLUMNS)):
            if owners[k, first + i] != paint:
                paint = owners[k, first + i]
                b, g, r = _shade(paint, row, column, scratch, view)
            blue, green, red = blue + weight * b, green + weight * g, red + weight * r
    return blue, green, red


@exact_function
def _find_places(
    row: int, view: View, ground: Ground, texture: UInt32, light: UInt8, places: Int32, parts: Float32
) -> None:
    """Write which points of texture and light a row of pixels shows on the table: column and row of either.

    `parts` are the fractions. Places beyond an image are at its border. With numbers of 32 bits and without branches,
    several pixels are computed at once.
    """
    x, y, z = (
        np.float32(view.rays[0][1] * row + view.rays[0][2]),
        np.float32(view.rays[1][1] * row + view.rays[1][2]),
        np.float32(view.rays[2][1] * row + view.rays[2][2]),
    )
    step_x, step_y, step_z = (
        np.float32(view.rays[0][0]),
        np.float32(view.rays[1][0]),
        np.float32(view.rays[2][0]),
    )
    eye_x, eye_y = np.float32(view.eye[0] - ground.x), np.float32(view.eye[1] - ground.y)
    height = np.float32(view.eye[2])
    for column in range(places.shape[1]):
        u = np.float32(np.int32(column))
        reach = -height / (z + step_z * u)
        table_x, table_y = eye_x + reach * (x + step_x * u), eye_y + reach * (y + step_y * u)
        scale, light_scale = np.float32(ground.scale), np.float32(ground.light_scale)
        _write_place(
            np.float32(table_x * scale), np.float32(table_y * scale), texture, places, parts, 0, column
        )
        x_light, y_light = np.float32(table_x * light_scale), np.float32(table_y * light_scale)
        _write_place(x_light, y_light, light, places, parts, 2, column)


@exact_function
def _write_place(
    x: np.float32, y: np.float32, image: UInt8 | UInt32, places: Int32, parts: Float32, k: int, column: int
) -> None:
    least = np.float32(0)
    right = np.float32(min(max(least, x), np.float32(image.shape[1] - 1.001)))
    down = np.float32(min(max(least, y), np.float32(image.shape[0] - 1.001)))
    i, j = np.int32(right), np.int32(down)
    places[k, column], places[k + 1, column] = i, j
    parts[k, column], parts[k + 1, column] = right - np.float32(i), down - np.float32(j)


@exact_function
def _read_points(places: Int32, texture: UInt32, light: UInt8, texels: UInt32, lights: UInt8) -> None:
    """Write the four points of texture and light around each place: upper two, lower two."""
    for column in range(np.uint64(places.shape[1])):
        i, j = np.uint64(places[0, column]), np.uint64(places[1, column])
        texels[0, column], texels[1, column] = texture[j, i], texture[j, i + _ONE]
        texels[2, column], texels[3, column] = texture[j + _ONE, i], texture[j + _ONE, i + _ONE]
        i, j = np.uint64(places[2, column]), np.uint64(places[3, column])
        lights[0, column], lights[1, column] = light[j, i], light[j, i + _ONE]
        lights[2, column], lights[3, column] = light[j + _ONE, i], light[j + _ONE, i + _ONE]


@exact_function
def _blend(
    parts: Float32, texels: UInt32, lights: UInt8, gain: float, brightness: Float32, table: UInt8
) -> None:
    """Write the light, 0 to 1, and the table's blue, green and red in it."""
    one, half, full, factor = np.float32(1), np.float32(0.5), np.float32(255), np.float32(gain)
    for column in range(table.shape[1]):
        right, down = parts[2, column], parts[3, column]
        upper = (one - right) * lights[0, column] + right * lights[1, column]
        lower = (one - right) * lights[2, column] + right * lights[3, column]
        light = ((one - down) * upper + down * lower) / full
        brightness[column] = light
        light *= factor
        table[0, column] = np.uint8(np.int32(min(light * _mix(texels, column, 0, parts) + half, full)))
        table[1, column] = np.uint8(np.int32(min(light * _mix(texels, column, 8, parts) + half, full)))
        table[2, column] = np.uint8(np.int32(min(light * _mix(texels, column, 16, parts) + half, full)))


@exact_function
def _mix(texels: UInt32, column: int, shift: int, parts: Float32) -> np.float32:
    """Return the bilinear value, 0 to 255, of the eight bits from bit `shift` of texels on."""
    one, right, down = np.float32(1), parts[0, column], parts[1, column]
    a, b = np.int32(texels[0, column] >> shift & 255), np.int32(texels[1, column] >> shift & 255)
    c, d = np.int32(texels[2, column] >> shift & 255), np.int32(texels[3, column] >> shift & 255)
    upper = (one - right) * np.float32(a) + right * np.float32(b)
    lower = (one - right) * np.float32(c) + right * np.float32(d)
    return np.float32((one - down) * upper + down * lower)


@exact_function
def _shade(paint: int, row: int, column: int | np.uint64, scratch: Scratch, view: View) -> Vector:
    """Return the colour (blue, green, red) of a paint at a pixel."""
    finish, paints, table = scratch.finishes[paint], scratch.paints, scratch.table
    if finish == GROUND:
        return float(table[0, column]), float(table[1, column]), float(table[2, column])
    if finish == _BACKGROUND:
        u, v = float(np.int64(column)), float(row)
        x = view.rays[0][0] * u + view.rays[0][1] * v + view.rays[0][2]
        y = view.rays[1][0] * u + view.rays[1][1] * v + view.rays[1][2]
        z = view.rays[2][0] * u + view.rays[2][1] * v + view.rays[2][2]
        blue, green, red = _room(view.eye, x, y, z)
        return blue * view.gain, green * view.gain, red * view.gain
    light = float(scratch.brightness[column]) if finish == SHADED else 1.0
    return paints[paint, 0] * light, paints[paint, 1] * light, paints[paint, 2] * light


@exact_function
def _room(eye: Vector, x: float, y: float, z: float) -> Vector:
    """Return the colour of the room in the direction (x, y, z) from the eye: floor, ceiling, and walls darker below."""
    reach_x, reach_y, reach_z = _reach(eye, x, 0), _reach(eye, y, 1), _reach(eye, z, 2)
    if reach_z <= min(reach_x, reach_y):
        return (226.0, 226.0, 224.0) if z > 0 else (92.0, 88.0, 84.0)
    tone = (
        (_WALLS[0][1] if x > 0 else _WALLS[0][0])
        if reach_x < reach_y
        else (_WALLS[1][1] if y > 0 else _WALLS[1][0])
    )
    if eye[2] + min(reach_x, reach_y) * z > _SKIRTING:
        return tone, tone - 2, tone - 8
    return 0.72 * tone + 6, 0.72 * tone, 0.72 * tone - 8


@exact_function
def _reach(eye: Vector, component: float, axis: int) -> float:
    """Return how many times a direction, of which `component` is along `axis`, leads from the eye to the room's end."""
    if component == 0:
        return 1e9
    return (_ROOM[axis][1 if component > 0 else 0] - eye[axis]) / component
