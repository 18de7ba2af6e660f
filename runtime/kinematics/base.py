"""Interface of kinematics backends: forward kinematics of end effectors, and inverse kinematics."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import IntFlag
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from robots import Robot
from runtime.core.errors import RuntimeFault
from runtime.core.settings import Settings
from runtime.core.types import Float64

Positive = Annotated[float, Field(gt=0)]


class KinematicsError(RuntimeFault):
    """Error about joints, poses or a seed of the wrong shape, or about numbers that are no pose."""


class IkFlag(IntFlag):
    """Properties of a solved frame, as bits of IkResult.flags."""

    OVER_TOLERANCE = 1
    AT_LIMIT = 2  # a joint is at its limit
    AT_VELOCITY = 4  # a joint moves at its velocity limit
    NEAR_SINGULAR = 8  # the end effector can hardly move in some direction


class KinematicsSettings(Settings):
    """Settings common to all backends."""

    position_weight: Positive = 50.0
    """Cost per metre of position error."""
    rotation_weight: Positive = 10.0
    """Cost per radian of orientation error."""
    rest_weight: Annotated[float, Field(ge=0)] = 0.01
    """Cost per radian of deviation from the joints that the previous frame leads to; it determines the joints that the
    pose leaves undetermined. At 1, reachable poses are missed by millimetres."""
    position_tolerance: Positive = 1e-3
    """Position error up to which a target counts as reached [m]."""
    rotation_tolerance: Positive = math.radians(0.5)
    """Orientation error up to which a target counts as reached [rad]."""
    max_iterations: Annotated[int, Field(ge=1)] = 60
    """Largest number of solver iterations per frame and arm."""
    velocity_scale: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Share of the joint velocity limits that solved frames may use."""
    singular_below: Annotated[float, Field(ge=0)] = 0.02
    """Smallest singular value of the Jacobian (m and rad alike) below which a frame counts as near singular."""


@dataclass(frozen=True, slots=True)
class IkResult:
    """Solved joints for a sequence of target poses.

    `q` float64 [T, D] are full robot vectors; `position_error` [T, arms] in m and `rotation_error` [T, arms] in rad are
    the errors of `q`; `flags` uint8 [T, arms] are bits of IkFlag.
    """

    q: Float64
    position_error: Float64
    rotation_error: Float64
    flags: NDArray[np.uint8]

    @property
    def reached(self) -> NDArray[np.bool_]:
        """Whether both errors are within tolerance, bool [T, arms]."""
        within: NDArray[np.bool_] = (self.flags & IkFlag.OVER_TOLERANCE) == 0
        return within


class Forward(ABC):
    """Forward kinematics of a robot: arms in its order, poses in each arm's declared frame."""

    @abstractmethod
    def forward(self, q: Float64) -> Float64:
        """Return poses [..., arms, 7] (x, y, z, qw, qx, qy, qz with qw >= 0) for joint vectors [..., D]."""


class Kinematics(Forward):
    """Forward and inverse kinematics of a robot."""

    def prepare(self) -> bool:
        """Start to load everything that `solve` needs; return True if it is loaded, so that `solve` would not have to
        wait.
        """
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
        """Solve for the poses `targets` in sequence: each frame starts from the solution of the frame before it.

        Dimensions of `seed` outside the arms' chains (grippers, head) are copied to every frame, and joints that carry
        an arm (a torso) are assumed to stay as in `seed`. No joint leaves its limits. Poses that are not reached are
        flagged. How redundant joints move depends on the backend.

        Args:
            targets: Poses [T, arms, 7], each in its arm's declared frame.
            seed: Joints [D] from which the first frame is solved.
            dt: Time between frames [s]; if given, no joint exceeds its velocity limit between frames.
            anchor: Joints [D] commanded for the step before row `anchor_row`; the velocity limit also applies to the
                motion from there to that row. If it is None, the first row is bound by joint limits only.
            anchor_row: First row that will be executed; rows before it are stale, and bound by joint limits only.
        """


class ChainForward(Forward):
    """Forward kinematics by the robot's own chains: tens of microseconds per vector, nothing to compile."""

    def __init__(self, robot: Robot) -> None:
        self._arms = robot.arms
        self._dim = robot.dim

    def forward(self, q: Float64) -> Float64:
        """Return poses [..., arms, 7] for joint vectors [..., D].

        Raises:
            KinematicsError: The joint vectors have another width.
        """
        q = np.asarray(q, dtype=np.float64)
        if q.shape[-1:] != (self._dim,):
            raise KinematicsError(f"joints of shape {q.shape} were given; allowed: [..., {self._dim}]")
        poses = np.empty((*q.shape[:-1], len(self._arms), 7))
        for index, arm in enumerate(self._arms):
            poses[..., index, :] = arm.pose(q)
        return poses
