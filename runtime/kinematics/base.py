"""What kinematics answers: where the end effectors are, and which joints put them somewhere."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from runtime.types import Float64


@dataclass(frozen=True, slots=True)
class IkResult:
    """Joints for a sequence of targets.

    `q` float64 [T, D] full robot vectors; `position_error` [T, arms] in m, `rotation_error` [T, arms] in rad;
    `reached` bool [T, arms]: both within tolerance.
    """

    q: Float64
    position_error: Float64
    rotation_error: Float64
    reached: Float64


class Kinematics(ABC):
    """Forward and inverse kinematics of one robot, arms in the robot's order, poses in each arm's declared frame."""

    @abstractmethod
    def forward(self, q: Float64) -> Float64:
        """Poses [..., arms, 7] (x, y, z, qw, qx, qy, qz with qw >= 0) for joint vectors [..., D]."""

    @abstractmethod
    def solve(self, targets: Float64, seed: Float64) -> IkResult:
        """Joints for poses [T, arms, 7], each frame started from the one before, the first from `seed` [D].

        Dimensions of `seed` that no arm's chain uses (grippers, head) are passed through.
        """
