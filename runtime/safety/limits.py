"""Limits of a robot: bounds and kind of each dimension."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from runtime.core.types import Float64

# At the default 60 rad/s2 a gripper covers its travel from rest to rest in 0.1 s, as real grippers do.
GRIPPER_TRAVEL = 6.7


@dataclass(frozen=True, slots=True)
class Limits:
    """Bounds of a robot, float64 [D] each; `binary` marks dimensions that switch between two values.

    `speeds` are the indices of dimensions that are speeds (of a mobile base) instead of positions: 0 is standstill, and
    their entries in `velocity` are limits of acceleration.
    """

    names: tuple[str, ...]
    lower: Float64
    upper: Float64
    velocity: Float64
    grippers: np.ndarray  # bool [D]: own unit, not radians
    binary: np.ndarray  # bool [D]
    speeds: tuple[int, ...] = ()

    @property
    def position_mask(self) -> np.ndarray:
        """Mask of the dimensions that are joint positions, bool [D]: neither grippers nor speeds."""
        places = ~self.grippers
        places[list(self.speeds)] = False
        return places

    def with_zero_speeds(self, position: Float64) -> Float64:
        """Return `position` [D] with all speeds set to 0."""
        if not self.speeds:
            return position
        standing = position.copy()
        standing[list(self.speeds)] = 0.0
        return standing

    def excess(self, position: Float64) -> Float64:
        """Return the distance of `position` [..., D] beyond its bounds, 0 within them."""
        return np.maximum(np.maximum(self.lower - position, position - self.upper), 0.0)

    @property
    def radian_scale(self) -> Float64:
        """Change of each dimension that counts as one radian [D]; 1 for angles.

        A gripper's accelerations are scaled so that its whole travel counts as GRIPPER_TRAVEL radians, whatever its
        unit: metres, 0..1, 0..100.
        """
        return np.where(self.grippers, (self.upper - self.lower) * GRIPPER_TRAVEL, 1.0)
