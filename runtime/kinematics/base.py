"""Interface of kinematics: poses of the end effectors, and joints that put them somewhere."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import IntFlag
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from runtime.core.errors import RuntimeFault
from runtime.core.settings import Settings
from runtime.core.types import Float64

Positive = Annotated[float, Field(gt=0)]


class KinematicsError(RuntimeFault):
    """Joints, poses or a seed of the wrong shape, or numbers that no pose can have."""


class IkFlag(IntFlag):
    """Findings on a solved frame; bits of IkResult.flags."""

    OVER_TOLERANCE = 1
    AT_LIMIT = 2  # a joint rests on its limit
    AT_VELOCITY = 4  # a joint moves as fast as it may
    NEAR_SINGULAR = 8  # some direction of the end effector can hardly be moved in


class KinematicsSettings(Settings):
    """Settings that every backend has."""

    position_weight: Positive = 50.0
    """Cost of a metre beside the pose."""
    rotation_weight: Positive = 10.0
    """Cost of a radian beside it."""
    rest_weight: Annotated[float, Field(ge=0)] = 0.01
    """Cost of a radian away from where the frame before leads: holds what the pose leaves open. At 1, reachable
    poses are missed by millimetres."""
    position_tolerance: Positive = 1e-3
    """Metres within which a target counts as reached."""
    rotation_tolerance: Positive = math.radians(0.5)
    """Radians within which a target counts as reached."""
    max_iterations: Annotated[int, Field(ge=1)] = 60
    """Per frame and arm."""
    velocity_scale: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Part of the joint velocities that solved frames may use."""
    singular_below: Annotated[float, Field(ge=0)] = 0.02
    """Smallest singular value of the Jacobian (m and rad alike) under which a frame counts as near singular."""


@dataclass(frozen=True, slots=True)
class IkResult:
    """Joints for a sequence of targets.

    `q` float64 [T, D] full robot vectors; `position_error` [T, arms] in m, `rotation_error` [T, arms] in rad, of
    the joints that are returned; `flags` uint8 [T, arms], bits of IkFlag.
    """

    q: Float64
    position_error: Float64
    rotation_error: Float64
    flags: NDArray[np.uint8]

    @property
    def reached(self) -> NDArray[np.bool_]:
        """bool [T, arms]: both errors within tolerance."""
        within: NDArray[np.bool_] = (self.flags & IkFlag.OVER_TOLERANCE) == 0
        return within


class Forward(ABC):
    """Poses of the end effectors of one robot: arms in its order, poses in each arm's declared frame."""

    @abstractmethod
    def forward(self, q: Float64) -> Float64:
        """Poses [..., arms, 7] (x, y, z, qw, qx, qy, qz with qw >= 0) for joint vectors [..., D]."""


class Kinematics(Forward):
    """Forward and inverse kinematics of one robot."""

    def prepare(self) -> bool:
        """Begin what `solve` needs, where nobody has; whether `solve` would not have to wait for it."""
        return True

    @abstractmethod
    def solve(
        self,
        targets: Float64,
        seed: Float64,
        dt: float | None = None,
        anchor: Float64 | None = None,
        anchor_row: int = 0,
    ) -> IkResult:
        """Joints for poses [T, arms, 7], each frame started from the one before, the first from `seed` [D].

        Dimensions of `seed` that no arm's chain uses (grippers, head) are passed through, and carriers (a torso)
        stand as in `seed`. No joint leaves its limits. Where `dt` [s] between frames is given, none moves faster than
        its velocity limit from one frame to the next; `anchor` [D] is what is commanded in the step before row
        `anchor_row`, the first that will be executed: that row is bound to it by the same velocity, and the rows
        before it, which are stale, by joint limits alone. Without an anchor the first row is bound by joint limits
        alone. What is not reached is flagged, never hidden. What a pose leaves open is the backend's.
        """
