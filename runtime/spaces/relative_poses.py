"""Conversion between relative and absolute poses.

An arm's vector is x, y, z [m], unit quaternion w, x, y, z, gripper; arrays are float64 [T, arms, 8].
"""

from __future__ import annotations

import numpy as np

from robots.rotations import matrix_of_quaternion, quaternion_product
from runtime.core.types import ActionMode, Float64, RelativeFrame
from runtime.spaces.orientations import continuous_signs

_POSITION, _QUATERNION = slice(0, 3), slice(3, 7)


def to_absolute(vectors: Float64, start: Float64, mode: ActionMode, frame: RelativeFrame) -> Float64:
    """Return absolute poses for relative `vectors` (unit quaternions); `start` [arms, 8] is the pose at the start.

    In the mode "relative" each row (dp, dq) is relative to `start`, in the mode "delta" to its predecessor. If that
    pose has the position p0, the quaternion q0 and the rotation matrix R0, the absolute row is (p0 + dp, dq q0) in the
    frame "base", and (p0 + R0 dp, q0 dq) in the frame "tool". Absolute `vectors` are returned unchanged. Grippers are
    absolute in every mode and are copied. Quaternions are returned unit and sign-continuous, w >= 0 in the first row.
    """
    if mode == "absolute":
        return vectors
    before = np.broadcast_to(start, vectors.shape)
    turns, shifts = vectors[..., _QUATERNION], vectors[..., _POSITION]
    result = vectors.copy()
    if mode == "relative":
        turned = _after(before[..., _QUATERNION], turns, frame)
    else:
        every = np.concatenate([start[None, :, _QUATERNION], turns])
        turned = _cumulative_products(every, frame)[1:]
        before = np.concatenate([start[None], vectors[:-1]])
        before[1:, :, _QUATERNION] = turned[:-1]
    if frame == "tool":
        shifts = (matrix_of_quaternion(before[..., _QUATERNION]) @ shifts[..., None])[..., 0]
    moved = shifts if mode == "relative" else shifts.cumsum(axis=0)
    result[..., _POSITION] = start[:, _POSITION] + moved
    turned *= np.where(turned[:1, :, :1] < 0, -1.0, 1.0)
    result[..., _QUATERNION] = turned * continuous_signs(turned)
    return result


def relative(vectors: Float64, start: Float64, mode: ActionMode, frame: RelativeFrame) -> Float64:
    """Convert absolute `vectors` (unit quaternions) to the action mode `mode`; the inverse of `to_absolute`.

    In mode "absolute" they are returned unchanged. In mode "delta" each row is relative to the row before it, and the
    first to `start` [arms, 8]. In other modes all rows are relative to `start`. `frame` states about which axes.
    """
    if mode == "absolute":
        return vectors
    before = np.broadcast_to(start, vectors.shape)
    if mode == "delta":
        before = np.concatenate([start[None], vectors[:-1]])
    back = before[..., _QUATERNION] * (1.0, -1.0, -1.0, -1.0)
    result = vectors.copy()
    result[..., _POSITION] -= before[..., _POSITION]
    if frame == "tool":
        shifts = result[..., _POSITION]
        result[..., _POSITION] = (matrix_of_quaternion(back) @ shifts[..., None])[..., 0]
        result[..., _QUATERNION] = quaternion_product(back, vectors[..., _QUATERNION])
    else:
        result[..., _QUATERNION] = quaternion_product(vectors[..., _QUATERNION], back)
    return result


def _after(before: Float64, turns: Float64, frame: RelativeFrame) -> Float64:
    """Return unit quaternions `before` rotated by `turns`, about their own axes ("tool") or about the frame's axes."""
    product = quaternion_product(before, turns) if frame == "tool" else quaternion_product(turns, before)
    unit: Float64 = product / np.linalg.norm(product, axis=-1, keepdims=True)
    return unit


def _cumulative_products(turns: Float64, frame: RelativeFrame) -> Float64:
    """Return cumulative products of the turns [T, arms, 4], by doubling (Hillis and Steele, 1986): log2 T products."""
    products, span = turns, 1
    while span < len(products):
        products = np.concatenate([products[:span], _after(products[:-span], products[span:], frame)])
        span *= 2
    return products
