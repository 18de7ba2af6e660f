"""End-effector vectors: made canonical, and placed where what they are relative to was.

An arm's vector is x, y, z [m], unit quaternion w, x, y, z, gripper; arrays are float64 [T, arms, 8].
"""

from __future__ import annotations

import numpy as np

from robots.rotations import matrix_of_quaternion, quaternion_product
from runtime.errors import PolicyError
from runtime.types import ActionMode, Float64, RelativeFrame

_POSE = slice(0, 7)
_POSITION, _QUATERNION = slice(0, 3), slice(3, 7)
_SHORTEST_QUATERNION = (
    1e-3  # a unit quaternion that a network predicts is off by per cents, never by this much
)


def canonical(vectors: Float64, whose: str = "the policy answered with") -> Float64:
    """The vectors with unit quaternions, first w >= 0, signs continuous along T.

    Raises PolicyError for a quaternion that is too short to have a direction; `whose` begins its sentence.
    """
    quaternions = vectors[..., _QUATERNION]
    norms = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    if (norms < _SHORTEST_QUATERNION).any():
        row, arm = np.argwhere(norms[..., 0] < _SHORTEST_QUATERNION)[0]
        raise PolicyError(
            f"{whose} quaternion {quaternions[row, arm].tolist()}, arm {arm}, row {row}; "
            f"allowed: w, x, y, z of length 1 (it is normalised from {_SHORTEST_QUATERNION:g} on)"
        )
    result = vectors.copy()
    result[..., _QUATERNION] = quaternions / norms
    result[0, :, _QUATERNION] *= np.where(result[0, :, 3:4] < 0, -1.0, 1.0)
    result[..., _QUATERNION] *= continuous_signs(result[..., _QUATERNION])
    return result


def continuous_signs(quaternions: Float64) -> Float64:
    """The factors +-1 [T, arms, 1] that turn each quaternion [T, arms, 4] to its predecessor's side."""
    dots = np.sum(quaternions[1:] * quaternions[:-1], axis=-1, keepdims=True)
    flips = np.where(dots < 0, -1.0, 1.0)
    signs = np.ones((*quaternions.shape[:-1], 1))
    signs[1:] = np.cumprod(flips, axis=0)
    return signs


def absolute(vectors: Float64, start: Float64, mode: ActionMode, frame: RelativeFrame) -> Float64:
    """Canonical `vectors` as absolute poses, from the pose `start` [arms, 8] that they are relative to.

    "relative": each from `start`; "delta": each from the one before. "base": p0 + dp, dq q0; "tool":
    p0 + R0 dp, q0 dq. Grippers are absolute in every mode and stay.
    """
    if mode == "absolute":
        return vectors
    result = vectors.copy()
    if mode == "relative":
        result[..., _POSE] = _moved(np.broadcast_to(start, vectors.shape), vectors, frame)
    else:
        pose = start
        for row, step in zip(result, vectors, strict=True):
            row[:, _POSE] = _moved(pose, step, frame)
            pose = row
    return canonical(result)


def _moved(pose: Float64, by: Float64, frame: RelativeFrame) -> Float64:
    """Poses [..., 7] that `pose` comes to by the offsets `by`."""
    quaternion, turn, offset = pose[..., _QUATERNION], by[..., _QUATERNION], by[..., _POSITION]
    if frame == "tool":
        offset = (matrix_of_quaternion(quaternion) @ offset[..., None])[..., 0]
        turned = quaternion_product(quaternion, turn)
    else:
        turned = quaternion_product(turn, quaternion)
    turned /= np.linalg.norm(turned, axis=-1, keepdims=True)
    return np.concatenate([pose[..., _POSITION] + offset, turned], axis=-1)
