"""Check of the straight path in joint space before a generated motion."""

from __future__ import annotations

import math

import numpy as np

from runtime.core.errors import RuntimeFault
from runtime.core.sentences import Pattern
from runtime.core.types import Float64
from runtime.motion.timeline import difference
from runtime.safety.collision import Collisions
from runtime.safety.workspace import Workspace
from runtime.station.spec import StationSpec

_LEAVES_WORKSPACE = Pattern("path.leaves_workspace", "{what}: {arm} would leave the workspace box on its way")
_COLLIDES = Pattern(
    "path.collides",
    "{what}: {collision} after {percent:.0f} % of the way: go by another pose, or move the robot by "
    "hand first",
)

_STEP = 0.01  # [rad, m] between checked postures, of the joint that moves farthest
# Margin: control checks the sent commands at other postures, and must not stop an accepted motion half-way.
_SPARE = 0.001  # [m]


class PathCheck:
    """Check of a robot's paths against workspace boxes and collisions."""

    def __init__(self, spec: StationSpec) -> None:
        safety = spec.deployment.safety
        self._limits = spec.limits
        self._wrapping = spec.dims.wrapping
        self._workspace = Workspace(spec.robot, safety.workspace)
        self._collisions = Collisions(spec.robot, safety.collision_margin + _SPARE)

    def check(self, what: str, start: Float64, goal: Float64) -> None:
        """Raise RuntimeFault if links collide on the path from `start` to `goal` [D], or if it leaves a workspace box.

        `what` begins the message. A path that begins outside a box cannot leave it before it has been inside.
        """
        path = self._path(start, goal)
        if arm := self._workspace.arm_leaving_on(path):
            raise RuntimeFault(_LEAVES_WORKSPACE(what=what, arm=arm))
        match = self._collisions.first_on_path(path)
        if match is not None:
            collision, at = match
            raise RuntimeFault(_COLLIDES(what=what, collision=collision, percent=100 * at / (len(path) - 1)))

    def _path(self, start: Float64, goal: Float64) -> Float64:
        """Return postures [T, D] from `start` to `goal` at most _STEP apart."""
        apart = difference(goal, start, self._wrapping)
        farthest = np.abs(apart).max(where=self._limits.position_mask, initial=0.0)
        count = max(2, math.ceil(farthest / _STEP) + 1)
        return np.asarray(start + np.linspace(0.0, 1.0, count)[:, None] * apart)
