"""Rotations between quaternions (w, x, y, z), matrices and rotation vectors, one at a time."""

from __future__ import annotations

import math

from runtime.kinematics.kernels.compiling import part
from runtime.types import Float64

_SMALL = 0.02  # sine below which five terms of the arc sine's series are exact to the last digit
_TURNED = -0.5  # cosine below which a matrix no longer shows its axis as a difference


@part
def matrix_of(quaternion: Float64, matrix: Float64) -> None:
    """Into `matrix` [9], row by row, of a quaternion [4] of any length above zero."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    scale = 2.0 / (w * w + x * x + y * y + z * z)
    matrix[0], matrix[1], matrix[2] = (
        1 - scale * (y * y + z * z),
        scale * (x * y - w * z),
        scale * (x * z + w * y),
    )
    matrix[3], matrix[4], matrix[5] = (
        scale * (x * y + w * z),
        1 - scale * (x * x + z * z),
        scale * (y * z - w * x),
    )
    matrix[6], matrix[7], matrix[8] = (
        scale * (x * z - w * y),
        scale * (y * z + w * x),
        1 - scale * (x * x + y * y),
    )


@part
def quaternion_of(matrix: Float64, quaternion: Float64) -> None:
    """Into `quaternion` [4], with w >= 0, of a matrix [9]: from the largest of its four squares (Shepperd 1978)."""
    a, b, c = matrix[0], matrix[4], matrix[8]
    squares = (1 + a + b + c, 1 + a - b - c, 1 - a + b - c, 1 - a - b + c)
    x, y, z = matrix[7] - matrix[5], matrix[2] - matrix[6], matrix[3] - matrix[1]
    xy, xz, yz = matrix[3] + matrix[1], matrix[2] + matrix[6], matrix[7] + matrix[5]
    largest = 0
    for index in range(1, 4):
        if squares[index] > squares[largest]:
            largest = index
    if largest == 0:
        row = (squares[0], x, y, z)
    elif largest == 1:
        row = (x, squares[1], xy, xz)
    elif largest == 2:
        row = (y, xy, squares[2], yz)
    else:
        row = (z, xz, yz, squares[3])
    length = math.sqrt(row[0] * row[0] + row[1] * row[1] + row[2] * row[2] + row[3] * row[3])
    scale = -1 / length if row[0] < 0 else 1 / length
    for index in range(4):
        quaternion[index] = scale * row[index]


@part
def rotation_between(found: Float64, wanted: Float64, vector: Float64, spare: Float64) -> None:
    """Into vector[0:3] the rotation [rad, axes of the frame] that leads from `wanted` to `found`, matrices [9].

    `spare` [13] is overwritten.
    """
    for i in range(3):
        for j in range(3):
            spare[3 * i + j] = (
                found[3 * i] * wanted[3 * j]
                + found[3 * i + 1] * wanted[3 * j + 1]
                + found[3 * i + 2] * wanted[3 * j + 2]
            )
    x, y, z = 0.5 * (spare[7] - spare[5]), 0.5 * (spare[2] - spare[6]), 0.5 * (spare[3] - spare[1])
    square = x * x + y * y + z * z
    cosine = 0.5 * (spare[0] + spare[4] + spare[8] - 1)
    if cosine < _TURNED:
        quaternion_of(spare[:9], spare[9:])
        x, y, z = spare[10], spare[11], spare[12]
        sine = math.sqrt(x * x + y * y + z * z)
        scale = 2 * math.atan2(sine, spare[9]) / sine
    elif square < _SMALL * _SMALL and cosine > 0:
        scale = 1 + square * (1 / 6 + square * (3 / 40 + square * (15 / 336 + square * (105 / 3456))))
    else:
        sine = math.sqrt(square)
        scale = math.atan2(sine, cosine) / sine
    vector[0], vector[1], vector[2] = scale * x, scale * y, scale * z
