"""Conversions between quaternions (w, x, y, z), matrices and rotation vectors, on scalars."""

from __future__ import annotations

import math

from runtime.core.types import Float64
from runtime.kinematics.kernels.compilation import device_function

_SMALL = 0.02  # sine below which four terms of the arc sine's series are exact to the last digit
_TURNED = -0.5  # cosine below which the antisymmetric part no longer determines the axis

Quaternion = tuple[float, float, float, float]
Vector = tuple[float, float, float]
Matrix = tuple[float, float, float, float, float, float, float, float, float]  # row by row


@device_function
def matrix_of(w: float, x: float, y: float, z: float) -> Matrix:
    """Return the rotation matrix of a quaternion of any length above zero."""
    scale = 2.0 / (w * w + x * x + y * y + z * z)
    return (
        1 - scale * (y * y + z * z),
        scale * (x * y - w * z),
        scale * (x * z + w * y),
        scale * (x * y + w * z),
        1 - scale * (x * x + z * z),
        scale * (y * z - w * x),
        scale * (x * z - w * y),
        scale * (y * z + w * x),
        1 - scale * (x * x + y * y),
    )


@device_function
def quaternion_of(matrix: Matrix) -> Quaternion:
    """Return the unit quaternion with w >= 0, from the largest of its four squares (Shepperd 1978)."""
    a, b, c = matrix[0], matrix[4], matrix[8]
    x, y, z = matrix[7] - matrix[5], matrix[2] - matrix[6], matrix[3] - matrix[1]
    xy, xz, yz = matrix[3] + matrix[1], matrix[2] + matrix[6], matrix[7] + matrix[5]
    if a + b + c >= 0:
        row = (1 + a + b + c, x, y, z)
    elif a >= b and a >= c:
        row = (x, 1 + a - b - c, xy, xz)
    elif b >= c:
        row = (y, xy, 1 - a + b - c, yz)
    else:
        row = (z, xz, yz, 1 - a - b + c)
    length = math.sqrt(row[0] * row[0] + row[1] * row[1] + row[2] * row[2] + row[3] * row[3])
    scale = -1 / length if row[0] < 0 else 1 / length
    return scale * row[0], scale * row[1], scale * row[2], scale * row[3]


@device_function
def rotation_vector(matrix: Matrix) -> Vector:
    """Return axis times angle; the angle is in [0, pi] rad."""
    x, y, z = 0.5 * (matrix[7] - matrix[5]), 0.5 * (matrix[2] - matrix[6]), 0.5 * (matrix[3] - matrix[1])
    square = x * x + y * y + z * z
    cosine = 0.5 * (matrix[0] + matrix[4] + matrix[8] - 1)
    if square < _SMALL * _SMALL and cosine > 0:
        scale = 1 + square * (1 / 6 + square * (3 / 40 + square * (15 / 336 + square * (105 / 3456))))
    elif cosine > _TURNED:
        sine = math.sqrt(square)
        scale = math.atan2(sine, cosine) / sine
    else:
        w, x, y, z = quaternion_of(matrix)
        sine = math.sqrt(x * x + y * y + z * z)
        scale = 2 * math.atan2(sine, w) / sine
    return scale * x, scale * y, scale * z


@device_function
def relative_rotation(frames: Float64, row: int, wanted: Float64) -> Matrix:
    """Return the rotation of frames[row] [12] times the transpose of that of `wanted` [12]."""
    a, b, c = frames[row, 0], frames[row, 1], frames[row, 2]
    d, e, f = frames[row, 3], frames[row, 4], frames[row, 5]
    g, h, i = frames[row, 6], frames[row, 7], frames[row, 8]
    p, q, r = wanted[0], wanted[1], wanted[2]
    s, t, u = wanted[3], wanted[4], wanted[5]
    v, w, x = wanted[6], wanted[7], wanted[8]
    return (
        a * p + b * q + c * r,
        a * s + b * t + c * u,
        a * v + b * w + c * x,
        d * p + e * q + f * r,
        d * s + e * t + f * u,
        d * v + e * w + f * x,
        g * p + h * q + i * r,
        g * s + h * t + i * u,
        g * v + h * w + i * x,
    )
