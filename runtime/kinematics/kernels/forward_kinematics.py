"""Forward kinematics and Jacobian of a chain.

Chains are records of chain_type: every joint turns about, or slides along, the z axis of its own frame. Frames are
twelve numbers: a rotation row by row, then the origin. Arguments named `reach` are scratch buffers, records of
fk_buffer_type.
"""

from __future__ import annotations

import numpy as np

from runtime.core.types import Float64
from runtime.kinematics.chain_records import Record, Records
from runtime.kinematics.kernels.compilation import device_function, kernel
from runtime.kinematics.kernels.rotations import compute_sincos, quaternion_of


def fk_buffer_type(moving: int) -> np.dtype[np.void]:
    """Return the type of the scratch buffer for a chain.

    It contains values, sines and cosines of the chain's joints, and the frames of its joints followed by that of its
    tip.
    """
    return np.dtype([("turns", np.float64, (3, moving)), ("frames", np.float64, (moving + 1, 12))])


@device_function
def compute_fk(chain: Record, q: Float64, row: int, reach: Record) -> None:
    """Compute in `reach` the joint frames and the tip of the chain for the driving numbers q[row]."""
    turns, frames = reach.turns, reach.frames
    for i in range(len(chain.drive)):
        drive = chain.drive[i]
        turns[0, i] = chain.offset[i] + (chain.factor[i] * q[row, drive] if drive >= 0 else 0.0)
    compute_sincos(turns)
    for k in range(12):
        frames[0, k] = chain.fixed[0, k]
    for i in range(len(chain.drive)):
        if i > 0:
            _compose_frame(chain, i, frames)
        if chain.slides[i]:
            for k in range(3):
                frames[i, 9 + k] += turns[0, i] * frames[i, 3 * k + 2]
        else:
            sine, cosine = turns[1, i], turns[2, i]
            for k in range(3):
                x, y = frames[i, 3 * k], frames[i, 3 * k + 1]
                frames[i, 3 * k] = cosine * x + sine * y
                frames[i, 3 * k + 1] = cosine * y - sine * x
    _compose_frame(chain, len(chain.drive), frames)


@device_function
def _compose_frame(chain: Record, index: int, frames: Float64) -> None:
    """Set frames[index] from the frame before it and the chain's `fixed` transform."""
    fixed = chain.fixed
    for i in range(3):
        a, b, c = frames[index - 1, 3 * i], frames[index - 1, 3 * i + 1], frames[index - 1, 3 * i + 2]
        for j in range(3):
            frames[index, 3 * i + j] = a * fixed[index, j] + b * fixed[index, 3 + j] + c * fixed[index, 6 + j]
        frames[index, 9 + i] = frames[index - 1, 9 + i] + (
            a * fixed[index, 9] + b * fixed[index, 10] + c * fixed[index, 11]
        )


@device_function
def compute_jacobian(
    chain: Record, reach: Record, position: float, rotation: float, jacobian: Float64
) -> None:
    """Write to jacobian [6, n] the derivatives of the tip's position and rotation vector with respect to q.

    The derivatives are multiplied by the weights `position` and `rotation`. `reach` is the scratch buffer with the
    frames of the chain's joints and of its tip.
    """
    frames, last = reach.frames, len(chain.drive)
    for k in range(6):
        for i in range(jacobian.shape[1]):
            jacobian[k, i] = 0.0
    for i in range(last):
        drive = chain.drive[i]
        if drive < 0:
            continue
        x, y, z = frames[i, 2], frames[i, 5], frames[i, 8]
        shift, turn = position * chain.factor[i], rotation * chain.factor[i]
        if chain.slides[i]:
            jacobian[0, drive] += shift * x
            jacobian[1, drive] += shift * y
            jacobian[2, drive] += shift * z
            continue
        a, b, c = (
            frames[last, 9] - frames[i, 9],
            frames[last, 10] - frames[i, 10],
            frames[last, 11] - frames[i, 11],
        )
        jacobian[0, drive] += shift * (y * c - z * b)
        jacobian[1, drive] += shift * (z * a - x * c)
        jacobian[2, drive] += shift * (x * b - y * a)
        jacobian[3, drive] += turn * x
        jacobian[4, drive] += turn * y
        jacobian[5, drive] += turn * z


@kernel
def compute_poses(chains: Records, q: Float64, reaches: Records, poses: Float64) -> None:
    """Write to poses [T, A, 7] (x, y, z, qw, qx, qy, qz with qw >= 0) the poses of the tips for joints q [T, D].

    `reaches` needs one element, as scratch memory.
    """
    reach = reaches[0]
    frames, last = reach.frames, len(reach.frames) - 1
    for row in range(len(q)):
        for index in range(len(chains)):
            compute_fk(chains[index], q, row, reach)
            a, b, c = frames[last, 0], frames[last, 1], frames[last, 2]
            d, e, f = frames[last, 3], frames[last, 4], frames[last, 5]
            g, h, i = frames[last, 6], frames[last, 7], frames[last, 8]
            w, x, y, z = quaternion_of((a, b, c, d, e, f, g, h, i))
            for k in range(3):
                poses[row, index, k] = frames[last, 9 + k]
            poses[row, index, 3], poses[row, index, 4] = w, x
            poses[row, index, 5], poses[row, index, 6] = y, z
