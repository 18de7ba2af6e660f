"""Block on the simulated bench: it rests, is pushed or held, falls, and settles on a face."""

from __future__ import annotations

import math

import numpy as np

from runtime.core.types import Float64
from runtime.simulation.bench.bench import BlockState

GRAVITY = 9.81  # [m/s^2]
_LEVELLING = 0.03  # [s] time constant with which a block settles from an edge onto a face
_LEVEL = 1e-3  # [rad] tilt below which a block lies flat
_MOVED = 1e-6  # [m, or part of a unit axis] least change that counts as motion


class Block:
    """Cube with edges of `edge` [m].

    `pose` [4, 4] is in the world, `held_by` is an arm's name or "", `still` is the time for which it has been at rest
    [s].
    """

    def __init__(self, pose: Float64, edge: float) -> None:
        self.pose = pose.copy()
        self.edge = edge
        self.held_by = ""
        self.still = math.inf
        self._grip = np.eye(4)  # pose in the fingertips of the arm that holds it
        self._falling = 0.0  # [m/s] downwards
        self._before = pose.copy()

    @property
    def bottom(self) -> float:
        """Height of its lowest corner [m]."""
        return float(self.pose[2, 3] - self.edge / 2 * np.abs(self.pose[2, :3]).sum())

    @property
    def top(self) -> float:
        """Height of its highest corner [m]."""
        return float(self.pose[2, 3] + self.edge / 2 * np.abs(self.pose[2, :3]).sum())

    @property
    def level(self) -> bool:
        """Whether the block lies flat."""
        return bool(np.abs(self.pose[2, :3]).max() > math.cos(_LEVEL))

    def state(self) -> BlockState:
        """Return the block's pose and the arm that holds it, for rendering."""
        return BlockState(self.pose.copy(), self.held_by)

    def shift(self, way: Float64) -> None:
        """Slide the block by the vector `way` [2] over its support."""
        self.pose[:2, 3] += way

    def turn(self, angle: float) -> None:
        """Rotate the block by `angle` [rad] about the vertical through its centre."""
        self.pose[:3, :3] = _about([0.0, 0.0, angle]) @ self.pose[:3, :3]

    def nearest(self, point: Float64) -> Float64:
        """Return the point [2] inside the outline of a flat block that is nearest to `point` [2]."""
        axes = self.sides()
        inside = np.clip(axes.T @ (point - self.pose[:2, 3]), -self.edge / 2, self.edge / 2)
        return np.asarray(self.pose[:2, 3] + axes @ inside)

    def offset(self, point: Float64) -> Float64:
        """Return `point` [2] relative to the block's centre, along the two sides of its outline."""
        return np.asarray(self.sides().T @ (point - self.pose[:2, 3]))

    def sides(self) -> Float64:
        """Return the directions of the block's sides over the table, as the columns of an array [2, 2]."""
        flattest = np.argsort(np.abs(self.pose[2, :3]))[0]
        along = self.pose[:2, flattest] / np.linalg.norm(self.pose[:2, flattest])
        return np.array([[along[0], -along[1]], [along[1], along[0]]])

    def attach_to(self, arm: str, tip: Float64) -> None:
        """Attach the block to an arm with fingertips at `tip` [4, 4]; from now on `carry` moves it."""
        self.held_by = arm
        self._falling = 0.0
        self._grip = np.linalg.inv(tip) @ self.pose

    def release(self) -> None:
        """Detach the block from the arm, so that it falls."""
        self.held_by = ""

    def carry(self, tip: Float64, support: float) -> None:
        """Move the block with the fingertips at `tip` [4, 4].

        If the block would then be lower than `support`, the height of the surface below it [m], it is pushed up in the
        fingers.
        """
        self.pose = tip @ self._grip
        below = support - self.bottom
        if below > 0:
            self.pose[2, 3] += below
            self._grip = np.linalg.inv(tip) @ self.pose

    def fall(self, support: float, seconds: float) -> None:
        """Let the block fall for `seconds` onto a support at height `support` [m], and settle there.

        A block below that height is raised onto the support.
        """
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
        """Rotate the block so that its lowest face approaches the support, as far as it turns in `seconds`."""
        face = int(np.argmax(np.abs(self.pose[2, :3])))
        up = self.pose[:3, face] * np.sign(self.pose[2, face])
        axis = np.cross(up, [0.0, 0.0, 1.0])
        sine = float(np.linalg.norm(axis))
        angle = math.atan2(sine, float(up[2]))
        share = 1.0 if angle < 10 * _LEVEL else -math.expm1(-seconds / _LEVELLING)
        self.pose[:3, :3] = _about(axis / sine * (share * angle)) @ self.pose[:3, :3]

    def update_rest(self, seconds: float) -> None:
        """Update `still`: add `seconds` if the block has not moved since the previous call and is not held, else set it
        to 0.
        """
        moved = float(np.abs(self.pose - self._before).max()) > _MOVED
        self.still = 0.0 if moved or self.held_by else self.still + seconds
        self._before = self.pose.copy()


def _about(vector: Float64 | list[float]) -> Float64:
    """Return the rotation [3, 3] of a rotation vector [3] (Rodrigues)."""
    vector = np.asarray(vector, np.float64)
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross)
