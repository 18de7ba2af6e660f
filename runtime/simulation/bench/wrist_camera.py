"""Placement of the camera on an arm: next to its hand, with a sufficient view of the space before the fingers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from robots import scene_of
from runtime.core.types import Float64
from runtime.simulation.bench.arm_frames import arm_frames

if TYPE_CHECKING:
    from robots import Robot, RobotScene

Point = tuple[float, float, float]

_BESIDE = (
    (0.095, -0.125),
    (0.13, -0.10),
    (0.12, -0.05),
    (0.16, -0.06),
    (0.14, 0.0),
)  # [m] candidate places: sideways and ahead of the fingertips
_AHEAD = 0.03  # [m] from the fingertips to the aim point
_ENOUGH = 0.8  # share of visible points that is sufficient
_SEEN = np.array([(x, y, z) for x in (-0.05, 0.0, 0.05) for y in (-0.05, 0.0, 0.05) for z in (0.0, 0.06)])
_SHORT = 0.995  # share of a ray; shapes beyond it do not hide the point, which may be on them


@dataclass(frozen=True, slots=True)
class CameraPlacement:
    """Place, aim point and up direction of a camera in the frame of the fingertips [m]."""

    place: Point = (-0.095, 0.0, -0.125)
    aim: Point = (-0.005, 0.0, _AHEAD)
    up: Point = (-1.0, 0.0, 0.0)


@lru_cache(maxsize=64)  # cache: a search, for robots that do not change
def place_wrist_camera(robot: Robot, arm: str) -> CameraPlacement:
    """Return the nearest placement on an arm with a sufficient view; without one, the placement with the best view.

    The view is judged in the ready posture, or at home if there is none.
    """
    q = robot.poses.get("ready", robot.poses["home"])
    tip = arm_frames(robot)[arm].tip(q)
    boxes = _Boxes(scene_of(robot), q)
    best, most = CameraPlacement(), -1.0
    for sideways, ahead in _BESIDE:
        for side in (-1.0, 1.0):
            eye = CameraPlacement(
                (side * sideways, 0.0, ahead), (side * 0.005, 0.0, _AHEAD), (side, 0.0, 0.0)
            )
            share = boxes.visible_share(_placed(tip, np.array(eye.place)), _placed(tip, _SEEN))
            if share >= _ENOUGH:
                return eye
            if share > most:
                best, most = eye, share
    return best


class _Boxes:
    """Bounding boxes of a robot's visual shapes in the world, at joints q [D]."""

    def __init__(self, scene: RobotScene, q: Float64) -> None:
        poses = scene.poses(q)
        places = np.stack([poses[visual.part] @ visual.origin for visual in scene.visuals])
        bounds = np.array([visual.bounds() for visual in scene.visuals])  # [S, 2, 3]
        self._low, self._high = bounds[:, 0], bounds[:, 1]
        self._back = np.linalg.inv(places)

    def visible_share(self, eye: Float64, points: Float64) -> float:
        """Return the share of points [n, 3] that no box hides from `eye` [3]; 0 if `eye` is inside a box."""
        start = self._back[:, :3, :3] @ eye + self._back[:, :3, 3]  # [S, 3]
        if ((start >= self._low) & (start <= self._high)).all(axis=1).any():
            return 0.0
        # Slab test: where each ray enters and leaves each box, as shares of its length.
        rays = np.einsum("sij,nj->nsi", self._back[:, :3, :3], points - eye)
        rays = np.where(np.abs(rays) < 1e-12, 1e-12, rays)
        low_crossing, high_crossing = (self._low - start) / rays, (self._high - start) / rays
        enters, leaves = (
            np.minimum(low_crossing, high_crossing).max(axis=-1),
            np.maximum(low_crossing, high_crossing).min(axis=-1),
        )
        hidden = (enters <= leaves) & (leaves > 0) & (enters < _SHORT)
        return float(1.0 - hidden.any(axis=1).mean())


def _placed(tip: Float64, points: Float64) -> Float64:
    """Transform points [..., 3] from the frame of the fingertips `tip` to the world."""
    return np.asarray(points @ tip[:3, :3].T + tip[:3, 3])
