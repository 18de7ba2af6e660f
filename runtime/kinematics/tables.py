"""Kinematic chains as tables of numbers, in the form that compiled loops read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robots import Chain
from runtime.types import Float64, UInt8


class ChainTables(NamedTuple):
    """Several chains [A] of M moving joints each, shorter ones filled up with joints that stand still.

    `fixed` float64 [A, M + 1, 12]: what lies before each joint, and behind the last: a rotation row by row, then
    the origin [m]; each joint turns about the z that this leads to, or slides along it where `slides` [A, M] is 1,
    by factor * q[drive] + offset [A, M]; drive is -1 where it stands still.
    """

    fixed: Float64
    slides: UInt8
    drive: NDArray[np.int64]
    factor: Float64
    offset: Float64


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """Chains one behind the other, each driven by its `dims` of a vector."""

    chains: Sequence[Chain]
    dims: Sequence[Sequence[int]]


def tables_of(ways: Sequence[Way]) -> ChainTables:
    """The tables of ways of any length."""
    longest = max((sum(len(chain.moving) for chain in way.chains) for way in ways), default=0)
    shape = (len(ways), longest)
    tables = ChainTables(
        np.tile(_flat(np.eye(4)), (len(ways), longest + 1, 1)),
        np.zeros(shape, dtype=np.uint8),
        np.full(shape, -1, dtype=np.int64),
        np.zeros(shape),
        np.zeros(shape),
    )
    for row, way in enumerate(ways):
        _fill(tables, row, way)
    return tables


def _fill(tables: ChainTables, row: int, way: Way) -> None:
    place, before = 0, np.eye(4)
    for chain, dims in zip(way.chains, way.dims, strict=True):
        for joint in chain.moving:
            basis = _basis(joint.axis)
            tables.fixed[row, place] = _flat(before @ joint.origin @ basis)
            tables.slides[row, place] = joint.slides
            tables.drive[row, place] = dims[joint.drive]
            tables.factor[row, place] = joint.factor
            tables.offset[row, place] = joint.offset
            before = basis.T
            place += 1
        before = before @ chain.tail
    tables.fixed[row, place] = _flat(before)


def _basis(axis: Float64) -> Float64:
    """A rotation [4, 4] that takes z to the unit vector `axis`; the identity where that is z."""
    across = np.array([0.0, 1.0, 0.0]) if abs(axis[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
    x = np.cross(across, axis)
    x /= np.linalg.norm(x)
    basis = np.eye(4)
    basis[:3, :3] = np.column_stack([x, np.cross(axis, x), axis])
    return basis


def _flat(transform: Float64) -> Float64:
    return np.concatenate([transform[:3, :3].ravel(), transform[:3, 3]])
