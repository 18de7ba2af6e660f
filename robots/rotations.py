"""Rotations as matrices and unit quaternions (w, x, y, z), float64, vectorised over leading axes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


def _outer_product_map() -> Float64:
    """Return the matrix [9, 16] that maps a flat rotation matrix R to the flat 4 q q^T - I."""
    w, x, y, z = range(4)
    terms = {  # entry of 4 q q^T: (row, column, sign) of R
        (w, w): [(0, 0, 1), (1, 1, 1), (2, 2, 1)],
        (x, x): [(0, 0, 1), (1, 1, -1), (2, 2, -1)],
        (y, y): [(0, 0, -1), (1, 1, 1), (2, 2, -1)],
        (z, z): [(0, 0, -1), (1, 1, -1), (2, 2, 1)],
        (w, x): [(2, 1, 1), (1, 2, -1)],
        (w, y): [(0, 2, 1), (2, 0, -1)],
        (w, z): [(1, 0, 1), (0, 1, -1)],
        (x, y): [(1, 0, 1), (0, 1, 1)],
        (x, z): [(0, 2, 1), (2, 0, 1)],
        (y, z): [(2, 1, 1), (1, 2, 1)],
    }
    table = np.zeros((9, 4, 4))
    for (a, b), entries in terms.items():
        for row, column, sign in entries:
            table[3 * row + column, a, b] = sign
            table[3 * row + column, b, a] = sign
    return table.reshape(9, 16)


_OUTER = _outer_product_map()
_IDENTITY = np.eye(4)


def matrix_of_rpy(roll: float, pitch: float, yaw: float) -> Float64:
    """Return the rotation [3, 3] = Rz(yaw) Ry(pitch) Rx(roll), the URDF's fixed-axis convention [rad]."""
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def matrix_of_quaternion(quaternion: Float64) -> Float64:
    """Return the rotations [..., 3, 3] of unit quaternions [..., 4]."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    matrix = np.empty((*quaternion.shape[:-1], 3, 3))
    for i, row in enumerate(rows):
        for j, entry in enumerate(row):
            matrix[..., i, j] = entry
    return matrix


def transform_of(pose: Float64) -> Float64:
    """Return the transforms [..., 4, 4] of poses [..., 7] = x, y, z, unit quaternion w, x, y, z."""
    transform = np.zeros((*pose.shape[:-1], 4, 4))
    transform[..., :3, :3] = matrix_of_quaternion(pose[..., 3:])
    transform[..., :3, 3] = pose[..., :3]
    transform[..., 3, 3] = 1.0
    return transform


def quaternion_of_matrix(matrix: Float64) -> Float64:
    """Return the unit quaternions [..., 4] with w >= 0 of rotations [..., 3, 3].

    4 q q^T is linear in the matrix; its row with the largest diagonal entry is the numerically safest multiple of q.
    """
    outer = (matrix.reshape(*matrix.shape[:-2], 9) @ _OUTER).reshape(*matrix.shape[:-2], 4, 4) + _IDENTITY
    largest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    if matrix.ndim == 2:
        row = outer[largest]
    else:
        row = np.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :]
    scale = np.sqrt(np.sum(row * row, axis=-1, keepdims=True))
    quaternion: Float64 = row / np.where(row[..., :1] < 0, -scale, scale)
    return quaternion


def rotation_vector(matrix: Float64) -> Float64:
    """Return the rotation vectors [..., 3] (axis times angle, in [0, pi] rad) of rotations [..., 3, 3]."""
    quaternion = quaternion_of_matrix(matrix)
    imaginary = quaternion[..., 1:]
    sine = np.sqrt(np.sum(imaginary * imaginary, axis=-1, keepdims=True))
    angle = 2 * np.arctan2(sine, quaternion[..., :1])
    vector: Float64 = imaginary * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)
    return vector


def quaternion_product(left: Float64, right: Float64) -> Float64:
    """Return the rotation `right` followed by the rotation `left`, as unit quaternions [..., 4]."""
    aw, ax, ay, az = np.moveaxis(left, -1, 0)
    bw, bx, by, bz = np.moveaxis(right, -1, 0)
    terms = (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )
    return np.stack(terms, axis=-1)


def slerp(start: Float64, end: Float64, part: Float64) -> Float64:
    """Return the unit quaternions [..., 4] at the share `part` [...] of the shorter path from `start` to `end`.

    Each result is in the hemisphere of `start`, which decides its sign. Source: Shoemake 1985. The angle is computed by
    atan2, because the arc cosine of a number near 1 loses half its digits.
    """
    end = np.where(np.sum(start * end, axis=-1, keepdims=True) < 0, -end, end)
    apart, along = np.linalg.norm(end - start, axis=-1), np.linalg.norm(end + start, axis=-1)
    angle = 2 * np.arctan2(apart, along)
    sine = np.sin(angle)
    near = sine < 1e-9
    safe = np.where(near, 1.0, sine)
    before = np.where(near, 1 - part, np.sin((1 - part) * angle) / safe)
    after = np.where(near, part, np.sin(part * angle) / safe)
    between = before[..., None] * start + after[..., None] * end
    quaternion: Float64 = between / np.linalg.norm(between, axis=-1, keepdims=True)
    return quaternion
