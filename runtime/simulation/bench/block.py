"""A block on the simulated bench: it lies, is pushed, is held, falls, and comes to lie on a face."""

from __future__ import annotations

import math

import numpy as np

from runtime.core.types import Float64
from runtime.simulation.bench.bench import BlockState

GRAVITY = 9.81  # m/s^2
_LEVELLING = 0.03  # s, the time constant with which a block that touches down on an edge drops on its face
_LEVEL = 1e-3  # rad below which it lies flat
_MOVED = 1e-6  # m or part of an axis


class Block:
    """A cube of `edge` [m]; `pose` [4, 4] in the world, `held_by` an arm's name or "", `still` [s] at rest."""

    def __init__(self, pose: Float64, edge: float) -> None:
        self.pose = pose.copy()
        self.edge = edge
        self.held_by = ""
        self.still = math.inf
        self._grip = np.eye(4)  # in the tip of the arm that holds it
        self._falling = 0.0  # m/s
        self._before = pose.copy()

    @property
    def bottom(self) -> float:
        """Height of its lowest corner."""
        return float(self.pose[2, 3] - self.edge / 2 * np.abs(self.pose[2, :3]).sum())

    @property
    def top(self) -> float:
        """Height of its highest corner."""
        return float(self.pose[2, 3] + self.edge / 2 * np.abs(self.pose[2, :3]).sum())

    @property
    def level(self) -> bool:
        """True if the block lies flat."""
        return bool(np.abs(self.pose[2, :3]).max() > math.cos(_LEVEL))

    def state(self) -> BlockState:
        """Its pose and holder, for pictures."""
        return BlockState(self.pose.copy(), self.held_by)

    def shift(self, way: Float64) -> None:
        """Slide it by [2] over what it lies on."""
        self.pose[:2, 3] += way

    def turn(self, angle: float) -> None:
        """Turn it about the vertical through its centre."""
        self.pose[:3, :3] = _about([0.0, 0.0, angle]) @ self.pose[:3, :3]

    def nearest(self, point: Float64) -> Float64:
        """The place [2] inside the outline of a flat block that is nearest to `point` [2]."""
        axes = self.sides()
        inside = np.clip(axes.T @ (point - self.pose[:2, 3]), -self.edge / 2, self.edge / 2)
        return np.asarray(self.pose[:2, 3] + axes @ inside)

    def offset(self, point: Float64) -> Float64:
        """`point` [2] along the two sides of its outline, from its centre."""
        return np.asarray(self.sides().T @ (point - self.pose[:2, 3]))

    def sides(self) -> Float64:
        """The directions of its sides over the table, the columns of [2, 2]."""
        flattest = np.argsort(np.abs(self.pose[2, :3]))[0]
        along = self.pose[:2, flattest] / np.linalg.norm(self.pose[:2, flattest])
        return np.array([[along[0], -along[1]], [along[1], along[0]]])

    def attach_to(self, arm: str, tip: Float64) -> None:
        """From now on it moves with the tip [4, 4] of an arm."""
        self.held_by = arm
        self._falling = 0.0
        self._grip = np.linalg.inv(tip) @ self.pose

    def release(self) -> None:
        """From now on it falls."""
        self.held_by = ""

    def carry(self, tip: Float64, support: float) -> None:
        """Follow the tip; what lies under it, up to height `support`, pushes it up in the fingers."""
        self.pose = tip @ self._grip
        below = support - self.bottom
        if below > 0:
            self.pose[2, 3] += below
            self._grip = np.linalg.inv(tip) @ self.pose

    def fall(self, support: float, seconds: float) -> None:
        """Fall for a while, down to height `support` and there onto a face; from below it comes up onto it."""
        gap = self.bottom - support
        self._falling += GRAVITY * seconds
        drop = self._falling * seconds
        if drop < gap:
            self.pose[2, 3] -= drop
            return
        self._falling = 0.0
        if not self.level:
            self._settle(seconds)
        self.pose[2, 3] += support - self.bottom

    def _settle(self, seconds: float) -> None:
        """Turn the face that points down most some way further down, or all the way."""
        face = int(np.argmax(np.abs(self.pose[2, :3])))
        up = self.pose[:3, face] * np.sign(self.pose[2, face])
        axis = np.cross(up, [0.0, 0.0, 1.0])
        sine = float(np.linalg.norm(axis))
        angle = math.atan2(sine, float(up[2]))
        share = 1.0 if angle < 10 * _LEVEL else -math.expm1(-seconds / _LEVELLING)
        self.pose[:3, :3] = _about(axis / sine * (share * angle)) @ self.pose[:3, :3]

    def update_rest(self, seconds: float) -> None:
        """Note whether it has moved since the last time this was asked."""
        moved = float(np.abs(self.pose - self._before).max()) > _MOVED
        self.still = 0.0 if moved or self.held_by else self.still + seconds
        self._before = self.pose.copy()


def _about(vector: Float64 | list[float]) -> Float64:
    """The rotation [3, 3] by a rotation vector [3] (Rodrigues)."""
    vector = np.asarray(vector, np.float64)
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross)
