"""Sines and cosines of several angles at once, and conversions of quaternions (w, x, y, z), matrices and rotation
vectors.
"""

from __future__ import annotations

import math

import numpy as np

from runtime.core.types import Float64
from runtime.kinematics.kernels.compilation import device_function

# A quarter turn in three parts, the first two of 33 bits, so that multiples of them are exact (Cody and Waite
# 1980).
_QUARTERS = 2 / math.pi
_FIRST = float.fromhex("0x1.921fb544p+0")
_SECOND = float.fromhex("0x1.0b4611a6p-34")
_THIRD = float.fromhex("0x1.3198a2e037073p-69")
# Minimax polynomials for an eighth of a turn to either side, with an error below 1e-16 (those of fdlibm).
_S1, _S2, _S3 = -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04
_S4, _S5, _S6 = 2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10
_C1, _C2, _C3 = 4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05
_C4, _C5, _C6 = -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11


@device_function
def compute_sincos(turns: Float64) -> None:
    """Write sines and cosines of the angles [rad] in row 0 of `turns` [3, N] to rows 1 and 2.

    The error is below 2e-16 for angles up to 1e5 rad.
    """
    for index in range(turns.shape[1]):
        angle = turns[0, index]
        quarters = np.floor(angle * _QUARTERS + 0.5)
        remainder = ((angle - quarters * _FIRST) - quarters * _SECOND) - quarters * _THIRD
        square = remainder * remainder
        sine = _S3 + square * (_S4 + square * (_S5 + square * _S6))
        sine = remainder + remainder * square * (_S1 + square * (_S2 + square * sine))
        cosine = _C3 + square * (_C4 + square * (_C5 + square * _C6))
        cosine = 1 - 0.5 * square + square * square * (_C1 + square * (_C2 + square * cosine))
        turn = quarters - 4 * np.floor(0.25 * quarters)  # 0, 1, 2 or 3 quarters
        swapped = turn == 1.0 or turn == 3.0
        of_sine, of_cosine = (cosine, sine) if swapped else (sine, cosine)
        turns[1, index] = -of_sine if turn >= 2.0 else of_sine
        turns[2, index] = -of_cosine if turn == 1.0 or turn == 2.0 else of_cosine


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
    """Return the unit quaternion with w >= 0, computed from the largest of its four squares (Shepperd 1978)."""
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
    """Return the rotation vector of a matrix, axis times angle; the angle is in [0, pi] rad."""
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
    """Return the rotation of frames[row] [12] times the transpose of the rotation of `wanted` [12]."""
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
