"""Orientation formats of policies and transports, converted to and from unit quaternions w, x, y, z.

Arrays are float64 [T, arms, n]: rows of a chunk, one orientation per arm. Independent of robots.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from robots.rotations import matrix_of_quaternion, quaternion_of_matrix, quaternion_product
from runtime.core.types import Float64

Bools = NDArray[np.bool_]
_WHOLE = 2.0 * np.pi
_LOCKED = 1e-10  # half the rotation that is neglected by fixing the free angle in a gimbal lock
_NO_AXIS = 1e-12
SHORTEST = 1e-3  # shortest usable vector: a network's error is per cents, never this much


class Orientation(ABC):
    """Orientation format: `fields` names its numbers, `allowed` describes the valid ones."""

    fields: tuple[str, ...]
    allowed: str

    @abstractmethod
    def encode(self, quaternions: Float64, previous: Float64 | None = None) -> Float64:
        """Encode unit quaternions as numbers [T, arms, n], each row as close to its predecessor as possible.

        The first row is as close as possible to `previous` [arms, n]; if that is None, it is in the usual range.
        """

    @abstractmethod
    def decode(self, numbers: Float64) -> tuple[Float64, Bools]:
        """Return unit quaternions, and whether the numbers determine each orientation, bool [T, arms].

        A quaternion is the identity if the numbers do not determine the orientation.
        """


class QuaternionOrientation(Orientation):
    """Four numbers of a quaternion, scalar first or last; signs are continuous from the first row on."""

    def __init__(self, scalar_first: bool) -> None:
        self.fields = ("qw", "qx", "qy", "qz") if scalar_first else ("qx", "qy", "qz", "qw")
        self.allowed = f"{', '.join(self.fields)} of length 1 (it is normalised from {SHORTEST:g} on)"
        self._order = [0, 1, 2, 3] if scalar_first else [1, 2, 3, 0]
        self._back = [0, 1, 2, 3] if scalar_first else [3, 0, 1, 2]

    def encode(self, quaternions: Float64, previous: Float64 | None = None) -> Float64:
        rows = quaternions[..., self._order]
        if previous is not None:
            rows = np.concatenate([previous[None], rows])
        rows = rows * continuous_signs(rows)
        return rows if previous is None else rows[1:]

    def decode(self, numbers: Float64) -> tuple[Float64, Bools]:
        return _normalised(numbers[..., self._back])


class RotationVector(Orientation):
    """Axis times angle; the angle is in [0, pi] at the first row, and may be larger in further rows."""

    fields = ("rx", "ry", "rz")
    allowed = "any three numbers"

    def __init__(self, degrees: bool = False) -> None:
        self._unit = np.pi / 180.0 if degrees else 1.0

    def encode(self, quaternions: Float64, previous: Float64 | None = None) -> Float64:
        """Encode unit quaternions; of all vectors of the same orientation the one closest to the previous row is
        chosen.
        """
        upright = quaternions * np.where(quaternions[..., :1] < 0, -1.0, 1.0)
        imaginary = upright[..., 1:]
        sine = np.linalg.norm(imaginary, axis=-1, keepdims=True)
        turned = sine > _NO_AXIS
        axes = imaginary / np.where(turned, sine, 1.0)
        angles = 2.0 * np.arctan2(sine, upright[..., :1])
        rows = np.where(turned, axes * angles, 2.0 * imaginary)
        before = None if previous is None else previous * self._unit
        for row, axis, angle in zip(rows, axes, angles, strict=True):
            if before is not None:
                row += _nearest_turns(before, axis, angle)
            before = row
        return rows / self._unit

    def decode(self, numbers: Float64) -> tuple[Float64, Bools]:
        vectors = numbers * self._unit
        half = 0.5 * np.linalg.norm(vectors, axis=-1, keepdims=True)
        imaginary = 0.5 * vectors * np.sinc(half / np.pi)
        quaternions = np.concatenate([np.cos(half), imaginary], axis=-1)
        return quaternions, np.ones(quaternions.shape[:-1], dtype=np.bool_)


class EulerAngles(Orientation):
    """Three angles in one of the twelve orders: "xyz" about fixed axes, "XYZ" about moving axes.

    They are computed from a quaternion as in Bernardes and Viollet, PLoS ONE 17 (2022) e0276302. In a gimbal lock one
    angle is free: the third angle about fixed axes, or the first about moving axes, then keeps its value from the
    previous row (0 if there is none).
    """

    allowed = "any three angles"

    def __init__(self, order: str, degrees: bool = False) -> None:
        self.fields = tuple(f"euler_{axis}{place}" for place, axis in enumerate(order, 1))
        self._unit = np.pi / 180.0 if degrees else 1.0
        self._fixed = order.islower()
        axes = ["xyz".index(axis) for axis in order.lower()]
        self._axes = axes if self._fixed else axes[::-1]  # as an order of fixed axes
        i, j, k = self._axes
        self._proper = i == k
        self._third = 3 - i - j if self._proper else k
        self._sign = float((i - j) * (j - self._third) * (self._third - i) // 2)

    def encode(self, quaternions: Float64, previous: Float64 | None = None) -> Float64:
        terms = self._terms(quaternions)
        order = slice(None) if self._fixed else slice(None, None, -1)
        before = None if previous is None else previous[..., order] * self._unit
        rows = np.empty((*quaternions.shape[:-1], 3))
        for row, first, second, along, across in zip(rows, *terms, strict=True):
            row[:] = self._angles(first, second, along, across, before)
            before = row
        return rows[..., order] / self._unit

    def decode(self, numbers: Float64) -> tuple[Float64, Bools]:
        half = 0.5 * self._unit * (numbers if self._fixed else numbers[..., ::-1])
        turns = np.zeros((3, *numbers.shape[:-1], 4))
        for place, axis in enumerate(self._axes):
            turns[place, ..., 0] = np.cos(half[..., place])
            turns[place, ..., 1 + axis] = np.sin(half[..., place])
        quaternions = quaternion_product(turns[2], quaternion_product(turns[1], turns[0]))
        return quaternions, np.ones(quaternions.shape[:-1], dtype=np.bool_)

    def _terms(self, quaternions: Float64) -> tuple[Float64, Float64, Float64, Float64]:
        """Return half sum and half difference of the outer angles, and two lengths that determine the middle angle."""
        i, j, _ = self._axes
        w, x = quaternions[..., 0], quaternions[..., 1 + i]
        y, z = quaternions[..., 1 + j], quaternions[..., 1 + self._third] * self._sign
        a, b, c, d = (w, x, y, z) if self._proper else (w - y, x + z, y + w, z - x)
        return np.arctan2(b, a), np.arctan2(d, c), np.hypot(a, b), np.hypot(c, d)

    def _angles(
        self, total: Float64, apart: Float64, along: Float64, across: Float64, before: Float64 | None
    ) -> Float64:
        """Return the angles [arms, 3] about fixed axes that are closest to `before` [arms, 3].

        The first four arguments are those that `_terms` returns, for one row. If `before` is None, the angles are in
        [-pi, pi].
        """
        third = np.zeros(len(total)) if before is None else self._raw(before[:, 2])
        total = np.where(along <= _LOCKED, third - apart, total)
        apart = np.where(across <= _LOCKED, third - total, apart)
        middle = 2.0 * np.arctan2(across, along) - (0.0 if self._proper else np.pi / 2)
        angles = np.stack([total - apart, middle, self._raw(total + apart)], axis=-1)
        if before is None:
            return _in_one_turn(angles)
        alternative = angles + np.pi
        alternative[:, 1] = -middle if self._proper else np.pi - middle
        angles, alternative = (
            before + _in_one_turn(angles - before),
            before + _in_one_turn(alternative - before),
        )
        nearer = np.abs(alternative - before).max(axis=-1) < np.abs(angles - before).max(axis=-1) - 1e-9
        return np.where(nearer[:, None], alternative, angles)

    def _raw(self, third: Float64) -> Float64:
        return third if self._proper else third * self._sign


class SixD(Orientation):
    """The first two columns, or the first two rows, of the rotation matrix in sequence.

    Decoded by Gram-Schmidt: any two vectors that are not parallel are valid. Zhou et al., On the Continuity of
    Rotation Representations in Neural Networks, CVPR 2019.
    """

    allowed = (
        f"two vectors of length 1, at right angles (they are straightened where {SHORTEST:g} is left of each)"
    )

    def __init__(self, columns: bool) -> None:
        self._columns = columns
        self.fields = tuple(f"{vector}{axis}" for vector in ("a", "b") for axis in "xyz")

    def encode(self, quaternions: Float64, previous: Float64 | None = None) -> Float64:
        del previous  # the encoding is unique
        matrices = matrix_of_quaternion(quaternions)
        if self._columns:
            matrices = np.swapaxes(matrices, -1, -2)
        return matrices[..., :2, :].reshape(*quaternions.shape[:-1], 6)

    def decode(self, numbers: Float64) -> tuple[Float64, Bools]:
        first, straight = _directions(numbers[..., :3], [1.0, 0.0, 0.0])
        second = numbers[..., 3:]
        orthogonal = second - np.sum(first * second, axis=-1, keepdims=True) * first
        second, apart = _directions(orthogonal, [0.0, 1.0, 0.0])
        determined = straight & apart
        matrices = np.stack([first, second, np.cross(first, second)], axis=-1 if self._columns else -2)
        matrices[~determined] = np.eye(3)
        return quaternion_of_matrix(matrices), determined


def continuous_signs(quaternions: Float64) -> Float64:
    """Return factors +1 or -1 [T, arms, 1] that make the signs of quaternions [T, arms, 4] continuous along T."""
    dots = np.sum(quaternions[1:] * quaternions[:-1], axis=-1, keepdims=True)
    signs = np.ones((*quaternions.shape[:-1], 1))
    signs[1:] = np.cumprod(np.where(dots < 0, -1.0, 1.0), axis=0)
    return signs


def _normalised(quaternions: Float64) -> tuple[Float64, Bools]:
    lengths = np.linalg.norm(quaternions, axis=-1)
    determined = lengths >= SHORTEST
    units = quaternions / np.where(determined, lengths, 1.0)[..., None]
    units[~determined] = [1.0, 0.0, 0.0, 0.0]
    return units, determined


def _directions(vectors: Float64, otherwise: list[float]) -> tuple[Float64, Bools]:
    lengths = np.linalg.norm(vectors, axis=-1)
    determined = lengths >= SHORTEST
    directions = vectors / np.where(determined, lengths, 1.0)[..., None]
    directions[~determined] = otherwise
    return directions, determined


def _nearest_turns(before: Float64, axis: Float64, angle: Float64) -> Float64:
    """Return the whole turns to add to rotation vectors so that they are as close as possible to `before`.

    The rotation vectors are given by their unit `axis` [arms, 3] and `angle` [arms, 1]; `before` [arms, 3] are the
    previous rotation vectors. A whole turn is a vector of length 2 pi along the axis. If a rotation is zero and
    therefore has no axis, the whole turns that `before` contains are repeated.
    """
    along = np.sum(before * axis, axis=-1, keepdims=True)
    length = np.linalg.norm(before, axis=-1, keepdims=True)
    none = ~axis.any(axis=-1, keepdims=True)
    direction = np.where(none, before / np.where(length > _NO_AXIS, length, 1.0), axis)
    turns = np.round(np.where(none, length, along - angle) / _WHOLE)
    return np.asarray(direction * turns * _WHOLE)


def _in_one_turn(angles: Float64) -> Float64:
    """Return the angles wrapped to [-pi, pi]; those already inside are unchanged, bit for bit."""
    return np.asarray(angles - _WHOLE * np.round(angles / _WHOLE))
