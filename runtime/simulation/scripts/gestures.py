"""Smooth, visible motion of a whole robot: what the stand-in policy answers and the stand-in leader does."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from runtime.core.types import Float32, Float64

if TYPE_CHECKING:
    from robots import Robot

_AMPLITUDE = 0.25  # rad
_TURN = 1.2  # rad/s of phase: one gesture takes 5.2 s
_SPEED = 0.8  # rad/s, at most
_LEAD = 0.13  # s by which targets lead the measured joints, as in teleoperated data
_GRIPPER_TIME = 2.0  # s for the whole way of a gripper, at least


class Gesture:
    """A closed path around home, by phase; the phase can be read off the joints, so no memory is needed.

    The first two joints of the first arm go round in a circle, which gives the phase; every other arm joint
    follows with a lag of its own; grippers open and close once a round; what is no arm stays.
    """

    def __init__(self, robot: Robot, seed: int = 0) -> None:
        self._robot = robot
        moving = np.concatenate([arm.joint_dims for arm in robot.arms])
        room = np.zeros(robot.dim)
        room[moving] = np.minimum(_AMPLITUDE, 0.45 * (robot.upper - robot.lower)[moving])
        home = robot.poses["home"]
        self._centre = np.clip(home, robot.lower + 1.1 * room, robot.upper - 1.1 * room)
        self._room = room
        self._still = np.setdiff1d(np.arange(robot.dim), [*moving, *robot.gripper_dims])
        self._lags = np.random.default_rng(seed).uniform(-0.6, 0.6, robot.dim)
        self._clockwork = moving[:2]
        self._lags[self._clockwork] = [0.0, -0.5 * np.pi]
        self._speed = np.minimum(robot.velocity, _SPEED)
        for dim in robot.gripper_dims:
            self._speed[dim] = (robot.upper - robot.lower)[dim] / _GRIPPER_TIME
        self._speed[list(robot.binary_dims)] = np.inf

    def joints_at(self, phase: float, q: Float64) -> Float64:
        """Joints [D] on the path; places that do not take part are those of `q`."""
        target = self._centre + self._room * np.sin(phase + self._lags)
        for arm in self._robot.arms:
            if arm.gripper is not None and arm.gripper_dim is not None:
                opened = 0.5 + 0.45 * np.sin(phase + self._lags[arm.gripper_dim])
                target[arm.gripper_dim] = arm.gripper.close + opened * (arm.gripper.open - arm.gripper.close)
        target[self._still] = q[self._still]
        return np.asarray(np.clip(target, self._robot.lower, self._robot.upper))

    def phase_of(self, q: Float64) -> float:
        """Phase of the joints [D] on the path, or of the point that they reach if moved straight onto it."""
        sine, minus_cosine = ((q - self._centre) / np.maximum(self._room, 1e-9))[self._clockwork]
        return float(np.arctan2(sine, -minus_cosine))

    def towards(self, phase: float, q: Float64, seconds: float) -> Float64:
        """The joints [D] that are reached from `q` on the way to the path within `seconds`."""
        reach = self._speed * seconds
        return np.asarray(q + np.clip(self.joints_at(phase, q) - q, -reach, reach))

    def chunk(self, q: Float64, horizon: int, rate: float) -> Float32:
        """float32 [horizon, D] from the joints `q` on, at `rate` [Hz]: the same for the same joints."""
        phase = self.phase_of(q) + _TURN * _LEAD
        rows = np.empty((horizon, self._robot.dim))
        now = np.clip(q, self._robot.lower, self._robot.upper)
        for row in range(horizon):
            now = self.towards(phase + _TURN * (row + 1) / rate, now, 1.0 / rate)
            rows[row] = now
        return rows.astype(np.float32)

    def turn(self, seconds: float) -> float:
        """Advance of the phase in `seconds`."""
        return _TURN * seconds
