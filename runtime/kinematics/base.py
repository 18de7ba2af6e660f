"""What kinematics answers: where the end effectors are, and which joints put them somewhere."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.errors import RuntimeFault
from runtime.types import Float64


class KinematicsError(RuntimeFault):
    """Joints, poses or a seed of the wrong shape, or numbers that no pose can have."""


@dataclass(frozen=True, slots=True)
class IkResult:
    """Joints for a sequence of targets.

    `q` float64 [T, D] full robot vectors; `position_error` [T, arms] in m, `rotation_error` [T, arms] in rad;
    `reached` bool [T, arms]: both within tolerance.
    """

    q: Float64
    position_error: Float64
    rotation_error: Float64
    reached: NDArray[np.bool_]


class Kinematics(ABC):
    """Forward and inverse kinematics of one robot: arms in its order, poses in each arm's declared frame."""

    @abstractmethod
    def forward(self, q: Float64) -> Float64:
        """Poses [..., arms, 7] (x, y, z, qw, qx, qy, qz with qw >= 0) for joint vectors [..., D]."""

    @abstractmethod
    def solve(self, targets: Float64, seed: Float64, dt: float | None = None) -> IkResult:
        """Joints for poses [T, arms, 7], each frame started from the one before, the first from `seed` [D].

        Dimensions of `seed` that no arm's chain uses (grippers, head) are passed through. No joint leaves its
        limits; where `dt` [s] between frames is given, none moves faster than its velocity limit from one
        frame to the next. What is not reached is reported, never hidden.
        """
