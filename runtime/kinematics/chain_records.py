"""Kinematic chains as numeric records for compiled loops.

Array lengths are part of a record's type: the compiler knows all addresses and unrolls small loops.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robots import Chain
from runtime.core.types import Float64

Record = Any  # element of an array of the types below: named fields of fixed length
Records = NDArray[np.void]
POSED = 6  # degrees of freedom of a pose: joints beyond them are redundant


def chain_type(moving: int) -> np.dtype[np.void]:
    """Return the type of a chain of up to `moving` joints; shorter chains are padded with fixed joints.

    `fixed` has the constant transforms before each joint and after the last, each as twelve numbers: a rotation row by
    row, then the origin [m]. The value of a joint is factor * q[drive] + offset; `drive` is -1 for a fixed joint. By
    this value the joint turns about the z axis that results from the transform before it [rad], or slides along that
    axis [m] if `slides` is 1.
    """
    return np.dtype(
        [
            ("fixed", np.float64, (moving + 1, 12)),
            ("factor", np.float64, (moving,)),
            ("offset", np.float64, (moving,)),
            ("drive", np.int64, (moving,)),
            ("slides", np.int64, (moving,)),
        ]
    )


@dataclass(frozen=True, slots=True, eq=False)
class ChainSequence:
    """Chains from base to tip, each on the end of the one before it.

    `dims` has for each chain the indices of its joints in the vector that drives them.
    """

    chains: Sequence[Chain]
    dims: Sequence[Sequence[int]]


def chain_records(ways: Sequence[ChainSequence]) -> Records:
    """Return one record per sequence [A], padded to the length of the longest."""
    longest = max((sum(len(chain.moving) for chain in sequence.chains) for sequence in ways), default=0)
    records = np.zeros(len(ways), dtype=chain_type(max(1, longest)))
    records["fixed"] = _flat(np.eye(4))
    records["drive"] = -1
    for record, sequence in zip(records, ways, strict=True):
        _fill(record, sequence)
    return records


def _fill(record: Record, sequence: ChainSequence) -> None:
    place, before = 0, np.eye(4)
    for chain, dims in zip(sequence.chains, sequence.dims, strict=True):
        for joint in chain.moving:
            basis = _basis(joint.axis)
            record["fixed"][place] = _flat(before @ joint.origin @ basis)
            record["factor"][place] = joint.factor
            record["offset"][place] = joint.offset
            record["drive"][place] = dims[joint.drive]
            record["slides"][place] = joint.slides
            before = basis.T
            place += 1
        before = before @ chain.tail
    record["fixed"][place] = _flat(before)


def _basis(axis: Float64) -> Float64:
    """Return a rotation [4, 4] that turns z to the unit vector `axis`; the identity if `axis` is z."""
    across = np.array([0.0, 1.0, 0.0]) if abs(axis[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
    x = np.cross(across, axis)
    x /= np.linalg.norm(x)
    basis = np.eye(4)
    basis[:3, :3] = np.column_stack([x, np.cross(axis, x), axis])
    return basis


def _flat(transform: Float64) -> Float64:
    return np.concatenate([transform[:3, :3].ravel(), transform[:3, 3]])
