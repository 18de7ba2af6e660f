"""Place of the camera on an arm: beside its hand, where enough of what lies before the fingers is in view."""

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
)  # m aside and ahead of the tip
_AHEAD = 0.03  # m from the fingertips to what the camera is aimed at
_ENOUGH = 0.8  # of the view, with which the nearest place is taken
_SEEN = np.array([(x, y, z) for x in (-0.05, 0.0, 0.05) for y in (-0.05, 0.0, 0.05) for z in (0.0, 0.06)])
_SHORT = 0.995  # of a way, at which it counts as gone: what is looked at does not hide itself


@dataclass(frozen=True, slots=True)
class CameraPlacement:
    """A camera's place, what it is aimed at, and what is up in its picture, in the frame of the fingertips [m]."""

    place: Point = (-0.095, 0.0, -0.125)
    aim: Point = (-0.005, 0.0, _AHEAD)
    up: Point = (-1.0, 0.0, 0.0)


@lru_cache(maxsize=64)  # cache: a search, for robots that do not change
def place_wrist_camera(robot: Robot, arm: str) -> CameraPlacement:
    """Of an arm: the nearest place from which enough is in view, else that with most, judged in the ready posture."""
    q = robot.poses.get("ready", robot.poses["home"])
    tip = arm_frames(robot)[arm].tip(q)
    boxes = _Boxes(scene_of(robot), q)
    best, most = CameraPlacement(), -1.0
    for aside, ahead in _BESIDE:
        for side in (-1.0, 1.0):
            eye = CameraPlacement((side * aside, 0.0, ahead), (side * 0.005, 0.0, _AHEAD), (side, 0.0, 0.0))
            share = boxes.visible_share(_placed(tip, np.array(eye.place)), _placed(tip, _SEEN))
            if share >= _ENOUGH:
                return eye
            if share > most:
                best, most = eye, share
    return best


class _Boxes:
    """The boxes around a robot's shapes in the world, at joints q [D]."""

    def __init__(self, scene: RobotScene, q: Float64) -> None:
        poses = scene.poses(q)
        places = np.stack([poses[visual.part] @ visual.origin for visual in scene.visuals])
        bounds = np.array([visual.bounds() for visual in scene.visuals])  # [S, 2, 3]
        self._low, self._high = bounds[:, 0], bounds[:, 1]
        self._back = np.linalg.inv(places)

    def visible_share(self, eye: Float64, points: Float64) -> float:
        """The share of points [n, 3] that no box hides from `eye` [3]; none from inside a box."""
        start = self._back[:, :3, :3] @ eye + self._back[:, :3, 3]  # [S, 3]
        if ((start >= self._low) & (start <= self._high)).all(axis=1).any():
            return 0.0
        way = np.einsum("sij,nj->nsi", self._back[:, :3, :3], points - eye)
        way = np.where(np.abs(way) < 1e-12, 1e-12, way)
        one, other = (self._low - start) / way, (self._high - start) / way
        enters, leaves = np.minimum(one, other).max(axis=-1), np.maximum(one, other).min(axis=-1)
        hidden = (enters <= leaves) & (leaves > 0) & (enters < _SHORT)
        return float(1.0 - hidden.any(axis=1).mean())


def _placed(tip: Float64, points: Float64) -> Float64:
    """Points [..., 3] of the fingertips' frame in the world."""
    return np.asarray(points @ tip[:3, :3].T + tip[:3, 3])
