"""Where a chain's tip is, and how it moves with the joints.

Chains are rows of ChainTables: every joint turns about, or slides along, the z of its own frame. Frames are twelve
numbers: a rotation row by row, then the origin.
"""

from __future__ import annotations

import numpy as np

from runtime.kinematics.kernels.compiling import kernel, part
from runtime.kinematics.kernels.rotations import quaternion_of
from runtime.kinematics.kernels.sines import sines_of
from runtime.kinematics.kernels.sizes import Size
from runtime.kinematics.tables import ChainTables
from runtime.types import Float64


@part
def frames_of(
    moving: Size, chain: int, tables: ChainTables, q: Float64, row: int, turns: Float64, frames: Float64
) -> None:
    """Into frames [M + 1, 12] those of a chain's joints, and last its tip, for q[row]; turns [3, M] is overwritten."""
    for i in range(len(moving)):
        drive = tables.drive[chain, i]
        turns[0, i] = tables.offset[chain, i] + (
            tables.factor[chain, i] * q[row, drive] if drive >= 0 else 0.0
        )
    sines_of(turns[0], turns[1], turns[2])
    for i in range(len(moving)):
        _behind(tables.fixed, chain, i, frames)
        if tables.slides[chain, i]:
            for k in range(3):
                frames[i, 9 + k] += turns[0, i] * frames[i, 3 * k + 2]
        else:
            sine, cosine = turns[1, i], turns[2, i]
            for k in range(3):
                x, y = frames[i, 3 * k], frames[i, 3 * k + 1]
                frames[i, 3 * k] = cosine * x + sine * y
                frames[i, 3 * k + 1] = cosine * y - sine * x
    _behind(tables.fixed, chain, len(moving), frames)


@part
def _behind(fixed: Float64, chain: int, index: int, frames: Float64) -> None:
    """frames[index], which `fixed` places behind the one before."""
    if index == 0:
        for k in range(12):
            frames[0, k] = fixed[chain, 0, k]
        return
    for i in range(3):
        a, b, c = frames[index - 1, 3 * i], frames[index - 1, 3 * i + 1], frames[index - 1, 3 * i + 2]
        for j in range(3):
            frames[index, 3 * i + j] = (
                a * fixed[chain, index, j] + b * fixed[chain, index, 3 + j] + c * fixed[chain, index, 6 + j]
            )
        frames[index, 9 + i] = frames[index - 1, 9 + i] + (
            a * fixed[chain, index, 9] + b * fixed[chain, index, 10] + c * fixed[chain, index, 11]
        )


@part
def jacobian_of(
    moving: Size, chain: int, tables: ChainTables, frames: Float64, weights: Float64, jacobian: Float64
) -> None:
    """Into jacobian [6, n] the weighted d(position, rotation vector)/dq of the tip of frames [M + 1, 12]."""
    m = len(moving)
    for k in range(6):
        for i in range(jacobian.shape[1]):
            jacobian[k, i] = 0.0
    for i in range(m):
        drive = tables.drive[chain, i]
        if drive < 0:
            continue
        x, y, z = frames[i, 2], frames[i, 5], frames[i, 8]
        near, turn = weights[0] * tables.factor[chain, i], weights[1] * tables.factor[chain, i]
        if tables.slides[chain, i]:
            jacobian[0, drive] += near * x
            jacobian[1, drive] += near * y
            jacobian[2, drive] += near * z
            continue
        a, b, c = frames[m, 9] - frames[i, 9], frames[m, 10] - frames[i, 10], frames[m, 11] - frames[i, 11]
        jacobian[0, drive] += near * (y * c - z * b)
        jacobian[1, drive] += near * (z * a - x * c)
        jacobian[2, drive] += near * (x * b - y * a)
        jacobian[3, drive] += turn * x
        jacobian[4, drive] += turn * y
        jacobian[5, drive] += turn * z


@kernel
def poses_of(moving: Size, tables: ChainTables, q: Float64, poses: Float64) -> None:
    """Into poses [T, A, 7] (x, y, z, qw, qx, qy, qz with qw >= 0) the chains' tips for q [T, D]."""
    turns = np.empty((3, len(moving)))
    frames = np.empty((len(moving) + 1, 12))
    tip = frames[len(moving)]
    for row in range(len(q)):
        for chain in range(len(tables.fixed)):
            frames_of(moving, chain, tables, q, row, turns, frames)
            for k in range(3):
                poses[row, chain, k] = tip[9 + k]
            quaternion_of(tip, poses[row, chain, 3:])
